"""The record of a photon map: vertices of light paths, an array of each field; and how they are read."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.samplers.bdpt.vertex import RADIANCE, context

# Photons on surfaces that face another way, by more than about 45 degrees, belong to another surface.
NORMAL_COSINE = 0.7


@dataclass
class Photon:
    """A photon or its copy: its place, the direction ``d`` along which it came, and its power Φ."""

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    Φ: mi.Spectrum
    place: mi.UInt32 | None = None  # in the map; None of a copy, here and below
    depth: mi.UInt32 | None = None  # edges from the light
    medium: mi.MediumPtr | None = None  # around it; None in scenes without media, too
    channel: mi.UInt32 | None = None  # the colour of its light path


def is_near(photon: Photon, x: mi.SurfaceInteraction3f, radius2: mi.Float) -> mi.Bool:
    """Whether a photon is gathered at ``x``."""
    return (dr.squared_norm(photon.p - x.p) < radius2) & faces(photon, x)


def faces(photon: Photon, x: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a photon lies on a surface that faces the same way as the surface at ``x``."""
    return dr.dot(photon.n, x.n) > NORMAL_COSINE


def light(photon: Photon, x: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active) -> mi.Spectrum:
    """f Φ, what a photon adds to radiance at ``x`` with material ``bsdf``, without the kernel."""
    f = bsdf.eval(context(RADIANCE), x, x.to_local(-photon.d), active)
    # f contains the shading cosine, but the density of photons follows the geometric one.
    L = f * photon.Φ / dr.abs(dr.dot(photon.n, photon.d))
    return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def photon_of(photons, j: mi.UInt32, active=True) -> Photon:
    def its(name: str):
        value = getattr(photons, name)
        return dr.gather(type(value), value, j, active)

    of_media = (its("medium"), its("channel")) if hasattr(photons, "medium") else (None, None)
    return Photon(its("p"), its("n"), its("d"), its("β"), j, its("depth"), *of_media)


@cache
def vertices_class(variant: str, in_media: bool = False, grids: bool = False, edges: bool = False) -> type:
    """The class of a map's vertices, for a scene ``in_media``, with ``grids`` among them, and with ``edges``.

    Mitsuba's types belong to a variant.
    """

    @dataclass
    class Vertices:
        """Vertices of light paths: 22 words each."""

        p: mi.Point3f
        n: mi.Normal3f  # geometric; 0 where light scatters in a medium
        d: mi.Vector3f  # of the light that arrives
        β: mi.Spectrum  # its power, times the number of light paths
        density: mi.Float  # with which d was sampled at the parent: infinite by a mirror or alike; 0 at a first vertex
        survival: mi.Float  # the probability to survive Russian roulette at the parent
        depth: mi.UInt32  # edges from the light; 0 where nothing is gathered: the vertex is only a parent
        parent: mi.UInt32  # its place in the map; of a first vertex, the number of its light path
        t: mi.Float  # the length of the edge from there
        prim_uv: mi.Point2f
        prim_index: mi.UInt32
        shape: mi.ShapePtr
        instance: mi.ShapePtr

        def __len__(self) -> int:
            return dr.width(self.t)

    kind: type = Vertices
    if in_media:

        @dataclass
        class VerticesInMedia(kind):  # type: ignore[misc, valid-type]
            """24 words each."""

            medium: mi.MediumPtr  # around it
            channel: mi.UInt32  # the colour by which the light path samples its distances

        kind = VerticesInMedia
    if grids:

        @dataclass
        class VerticesInGrids(kind):  # type: ignore[misc, valid-type]
            """27 words each; of the edge that leads there ``collisions.Collisions`` without M."""

            key: mi.UInt32
            nulls: mi.UInt32
            N_c: mi.Float

        kind = VerticesInGrids
    if edges:

        @dataclass
        class VerticesAndEdges(kind):  # type: ignore[misc, valid-type]
            """The edge that leads to a vertex, in the same place, or to nothing: 12 words more."""

            o: mi.Point3f  # where it begins
            e: mi.Vector3f  # its direction
            power: mi.Spectrum  # there, times the number of light paths
            begins: mi.MediumPtr  # there
            colour: mi.UInt32  # ``channel``
            bounce: mi.UInt32  # its number; 0 where there is none

        kind = VerticesAndEdges
    return kind


def vertex_of(photons, index: mi.UInt32, active=True) -> mi.SurfaceInteraction3f:
    """A vertex of a map on a surface, as the light path has come to it."""
    ray, hit = _met(photons, index, active)
    return hit.compute_surface_interaction(ray, active=active)


def vertex_in_media_of(photons, index: mi.UInt32, active=True) -> tuple[mi.SurfaceInteraction3f, media.Place]:
    """A vertex of a map of a scene with media, and its place."""
    ray, hit = _met(photons, index, active)
    scatters = active & (dr.squared_norm(dr.gather(mi.Normal3f, photons.n, index, active)) == 0)
    place = media.Place(dr.gather(mi.MediumPtr, photons.medium, index, active), scatters)
    return media.vertex(ray, hit, place), place


def _met(photons, index: mi.UInt32, active) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
    """The last piece of the ray that led to a vertex, and what it met there."""
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(index))
    for name in ("t", "prim_uv", "prim_index", "shape", "instance"):
        value = getattr(photons, name)
        setattr(hit, name, dr.gather(type(value), value, index, active))
    # Without this field the vertex would be invalid: no other field marks it.
    hit.valid = mi.Bool(active)
    p, d = dr.gather(mi.Point3f, photons.p, index, active), dr.gather(mi.Vector3f, photons.d, index, active)
    return mi.Ray3f(p - d * hit.t, d), hit


def on_surfaces(photons) -> mi.Bool:
    """Which vertices of a map are photons on surfaces."""
    return (photons.depth > 0) & (dr.squared_norm(photons.n) > 0)


def in_media(photons) -> mi.Bool:
    """Which vertices of a map are photons in a medium."""
    return (photons.depth > 0) & (dr.squared_norm(photons.n) == 0)


def put(photons, vertex, place: mi.UInt32, active) -> None:
    """Writes vertices to these places of a map."""
    for f in fields(vertex):
        dr.scatter(getattr(photons, f.name), getattr(vertex, f.name), place, active)


def at(some: Any, index: mi.UInt32) -> Any:
    """The entries at these places of a record of arrays; some arrays may be None."""
    values = (getattr(some, f.name) for f in fields(some))
    return type(some)(*(None if value is None else dr.gather(type(value), value, index) for value in values))
