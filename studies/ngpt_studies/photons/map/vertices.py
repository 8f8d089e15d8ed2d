"""The record of a photon map whose photons know their light paths; and how the vertices of these are made anew."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.samplers.photons.map import vertices
from data_gen.samplers.photons.map.vertices import faces


@dataclass
class Photon(vertices.Photon):
    """A photon or its copy, which has none of these."""

    place: mi.UInt32 | None = None  # in the map
    depth: mi.UInt32 | None = None  # edges from the light
    medium: mi.MediumPtr | None = None  # around it; None in scenes without media, too
    channel: mi.UInt32 | None = None  # the colour of its light path


def is_near(photon: Photon, x: mi.SurfaceInteraction3f, radius2: mi.Float) -> mi.Bool:
    """Whether a photon is gathered at ``x``."""
    return (dr.squared_norm(photon.p - x.p) < radius2) & faces(photon, x)


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

    base = vertices.vertices_class(variant, in_media)

    @dataclass
    class Vertices(base):  # type: ignore[misc, valid-type]
        """Vertices of light paths: 22 words each, in media 23. Those with a ``depth`` of 0 are only parents."""

        density: mi.Float  # with which d was sampled at the parent: infinite by a mirror or alike; 0 at a first vertex
        survival: mi.Float  # the probability to survive Russian roulette at the parent
        parent: mi.UInt32  # its place in the map; of a first vertex, the number of its light path
        t: mi.Float  # the length of the edge from there
        prim_uv: mi.Point2f
        prim_index: mi.UInt32
        shape: mi.ShapePtr
        instance: mi.ShapePtr

    kind: type = Vertices
    if in_media:

        @dataclass
        class VerticesInMedia(kind):  # type: ignore[misc, valid-type]
            """24 words each."""

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
