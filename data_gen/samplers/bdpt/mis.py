r"""MIS weights of all strategies that find a path: the balance heuristic, computed by recursion along both subpaths.

A path x0 (camera) x1 ... xk (light) is found by k + 1 strategies. In strategy s, s vertices of the path come from the
light and the others from the camera. If p_s is the density of strategy s, its weight is p_s / Σ p_j = 1 / (1 + others),
where

    others = Σ_{j≠s} p_j / p_s = the strategies with a longer light path + those with a longer camera path.

Each subpath updates its own part of this sum from vertex to vertex, without storing the densities (Georgiev 2012,
"Implementing Vertex Connection and Merging"). It keeps two partial sums:

    vcm   1 / the density of the last vertex: the first summand without its factors that are still unknown
    vc    the sum of all further summands, also without these factors

Densities do not include Russian roulette, so weights depend only on the path. Camera and light have the same formula
for their first edge, with e = p_emit / (p_connect cos). e is a quotient of two densities, per unit area facing the end
of the path (the camera or a lamp): the density of sampling the first edge from this end, and the density of choosing
this end for a connection. A connection cannot make a delta event. So the summands of a delta event are 0, and in later
summands the densities of its two directions cancel.

Holes that connections go through are no vertices: an edge leads through them, and its length is measured from vertex to
vertex. If a path passes a hole by chance, the probability of passing is no part of the path's density: the hole
attenuates the light of the path, as it does for a connection.

Both subpaths may also arrive at the same vertex and merge there (``vcm``). The density of a merge is the product of the
subpaths' densities times η = π r² N, for N light paths and radius r. Paths merge only at vertices where photons are
gathered, and only if the light came to the vertex from a delta event; all other paths are found by connections, without
blur. A light path knows at the vertex whether it came from a delta event: ``vcm`` is 0 then, and ``gathered`` adds η as
one more summand. A camera path knows it only when it leaves the next vertex, so η is ``waiting`` until then. Without
photons η is left out, as in ``bdpt``.

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
    """The sums at the first vertex that the camera sees. No strategy meets the camera by chance, so ``vc`` is 0."""
    return Partial(dr.rcp(e * cos), mi.Float(0))


def begin_light(e: mi.Float, p: mi.Float, delta: mi.Bool, cos: mi.Float) -> Partial:
    """The sums at the first vertex of a light path; ``p`` is the density of connecting this vertex to the lamp."""
    return Partial(dr.rcp(e * cos), dr.select(delta, 0, dr.rcp(e * p * cos)))


def leave(end: Partial, cos: mi.Float, p: mi.Float, q: mi.Float, delta: mi.Bool, η: mi.Float | float = 0.0) -> Partial:
    """The sums behind an event that was sampled with density ``p``. For camera paths, ``η`` is that of the vertex."""
    vc = dr.select(delta, (end.vc + end.waiting) * cos, cos / p * (end.vcm + end.vc * q))
    return Partial(dr.select(delta, 0, dr.rcp(p)), vc, dr.select(delta, 0, mi.Float(η) * (cos / p)))


def arrive(end: Partial, cos: mi.Float, distance2: mi.Float) -> Partial:
    """The sums at the next vertex, at the end of an edge of squared length ``distance2``."""
    return Partial(end.vcm * distance2 / cos, end.vc / cos, end.waiting * dr.rcp(cos))


def passed(end: Partial, cos: mi.Float, distance2: mi.Float) -> Partial:
    """The sums behind a hole, which is no vertex: undoes ``arrive()`` at the hole."""
    return Partial(end.vcm * (cos / distance2), end.vc * cos, end.waiting * cos)


def gathered(y: Partial, η: mi.Float) -> Partial:
    """The sums at a vertex of a light path, with the summand of merging; η is 0 where no photons are gathered."""
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
