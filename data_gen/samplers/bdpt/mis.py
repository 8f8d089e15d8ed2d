r"""MIS weights of all strategies that find a path: the balance heuristic, computed by recursion along both subpaths.

A path x0 (camera) x1 ... xk (light) is found by k + 1 strategies: s of its vertices come from the light, the others
from the camera. With p_s the density of strategy s, its weight is p_s / Σ p_j = 1 / (1 + others), where

    others = Σ_{j≠s} p_j / p_s = the strategies with a longer light path + those with a longer camera path.

Each subpath updates its own sum from vertex to vertex, without storing the densities (Georgiev 2012, "Implementing
Vertex Connection and Merging"):

    vcm   1 / the density of the last vertex: the first summand without its factors that are still unknown
    vc    the sum of all further summands, also without these factors

Densities do not include Russian roulette, so weights depend only on the path. Camera and light have the same formula
for their first edge, with e = p_emit / (p_connect cos). This is the density of sampling the first edge from the end of
the path, divided by the density of choosing that end for a connection, per unit area facing the end. A connection
cannot make a delta event: its summands are 0, and in later summands the densities of its two directions cancel.

Holes that connections go through are no vertices: an edge leads through them, and its length is measured from vertex to
vertex. If a path passes a hole by chance, the probability is a factor of its weight and not of its density, as for a
connection.

Both subpaths may also arrive at one vertex and merge. The density of a merge is the product of the subpaths' densities
times η = π r² N, for N light paths and radius r. Paths merge only at vertices where photons are gathered, and only if
the light came from a delta event; otherwise a connection finds the path without blur. A light path knows this at the
vertex: its ``vcm`` is 0 there, and ``gathered`` adds η as one more summand. A camera path knows it only when it leaves
the next vertex, so η is ``waiting`` until then. Without photons the formulas are the same as in ``bdpt``.

``p`` are densities in solid angle, and ``q`` are densities with both directions of the vertex swapped. Cosines are
absolute, to the geometric normal. Quotients are computed one by one, because squares of densities would leave the range
of float32.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi


@dataclass
class Partial:
    """The partial sums of one subpath, at its last vertex or on the edge behind it."""

    vcm: mi.Float
    vc: mi.Float
    # For a camera path: the term that is added to ``vc`` if the next event is a delta
    waiting: mi.Float = field(default_factory=lambda: mi.Float(0))


def begin_camera(e: mi.Float, cos: mi.Float) -> Partial:
    """At the first vertex that the camera sees. No strategy meets the camera by chance."""
    return Partial(dr.rcp(e * cos), mi.Float(0))


def begin_light(e: mi.Float, p: mi.Float, delta: mi.Bool, cos: mi.Float) -> Partial:
    """At the first vertex of a light path; ``p`` is the density of connecting that vertex to the light's end."""
    return Partial(dr.rcp(e * cos), dr.select(delta, 0, dr.rcp(e * p * cos)))


def leave(end: Partial, cos: mi.Float, p: mi.Float, q: mi.Float, delta: mi.Bool, η: mi.Float | float = 0.0) -> Partial:
    """Behind an event that was sampled with density ``p``. For camera paths, ``η`` is the η of the vertex."""
    vc = dr.select(delta, (end.vc + end.waiting) * cos, cos / p * (end.vcm + end.vc * q))
    return Partial(dr.select(delta, 0, dr.rcp(p)), vc, dr.select(delta, 0, mi.Float(η) * (cos / p)))


def arrive(end: Partial, cos: mi.Float, distance2: mi.Float) -> Partial:
    """At the next vertex, at the end of an edge of squared length ``distance2``."""
    return Partial(end.vcm * distance2 / cos, end.vc / cos, end.waiting * dr.rcp(cos))


def passed(end: Partial, cos: mi.Float, distance2: mi.Float) -> Partial:
    """Behind a hole, which is no vertex: undoes ``arrive()`` there."""
    return Partial(end.vcm * (cos / distance2), end.vc * cos, end.waiting * cos)


def gathered(y: Partial, η: mi.Float) -> Partial:
    """At a vertex of a light path, with the summand of merging; η is 0 where no photons are gathered."""
    return Partial(dr.select(y.vcm > 0, y.vcm, η), y.vc)


def others_merged(z: Partial, q_z: mi.Float, y: Partial, q_y: mi.Float, η: mi.Float) -> mi.Float:
    """``others`` for a camera path and a light path that merge at ``z`` and ``y``, their last vertices.

    ``q_y`` is the density of the direction to the light, ``q_z`` the density of the direction to the camera.
    ``y`` includes η.
    """
    return dr.maximum((z.vcm + z.vc * q_z + y.vcm + y.vc * q_y) / η - 1, 0)


def others_emitted(end: Partial, e: mi.Float, p: mi.Float) -> mi.Float:
    """``others`` for a camera path that met an emitter; ``p`` is the density of connecting to the emitter instead."""
    return p * (end.vcm + e * end.vc)


def others_to_light(end: Partial, e: mi.Float, p_light: mi.Float, cos: mi.Float, p, q) -> mi.Float:
    """``others`` for a camera path whose last vertex is connected to a light.

    ``p_light`` is the density of sampling that light; it is 0 for a delta light.
    """
    return dr.select(p_light > 0, p / p_light, 0) + others_to_camera(end, e, cos, q)


def others_to_camera(end: Partial, e: mi.Float, cos: mi.Float, q: mi.Float) -> mi.Float:
    """``others`` for a light path whose last vertex is connected to the camera."""
    return e * cos * (end.vcm + end.vc * q)


@dataclass
class Side:
    """One of the two vertices of a connection."""

    cos: mi.Float  # of the edge
    p: mi.Float  # density of sampling the edge
    q: mi.Float  # the same with both directions swapped


@dataclass
class Connection:
    """The edge between the last vertices of a camera path and a light path."""

    z: Side
    y: Side
    distance2: mi.Float


def others_connected(z: Partial, y: Partial, edge: Connection) -> mi.Float:
    """``others`` for a camera path connected to a light path; ``z`` and ``y`` are their last vertices."""
    from_camera = edge.z.p * edge.y.cos / edge.distance2 * (y.vcm + y.vc * edge.y.q)
    from_light = edge.y.p * edge.z.cos / edge.distance2 * (z.vcm + z.vc * edge.z.q)
    return from_camera + from_light
