"""The record of a photon map: vertices of light paths, with an array for each field, and functions that read them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.samplers.bdpt.vertex import RADIANCE, context

# Photons whose normals differ by more than about 45 degrees belong to another surface.
NORMAL_COSINE = 0.7


@dataclass
class Photon:
    """A photon: its place, the direction ``d`` along which it came, and its power Φ."""

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    Φ: mi.Spectrum


def photon_of(photons, j: mi.UInt32, active=True) -> Photon:
    """The photons at these places of a map."""
    values = (getattr(photons, name) for name in ("p", "n", "d", "β"))
    return Photon(*(dr.gather(type(value), value, j, active) for value in values))


def faces(photon: Photon, x: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a photon lies on a surface that faces the same way as the surface at ``x``."""
    return dr.dot(photon.n, x.n) > NORMAL_COSINE


def light(photon: Photon, x: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active) -> mi.Spectrum:
    """f Φ, the radiance that a photon adds at ``x`` with material ``bsdf``, without the factor of the kernel."""
    f = bsdf.eval(context(RADIANCE), x, x.to_local(-photon.d), active)
    # f contains the shading cosine, but the density of photons follows the geometric one.
    L = f * photon.Φ / dr.abs(dr.dot(photon.n, photon.d))
    return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


@cache
def vertices_class(variant: str, in_media: bool = False) -> type:
    """The class of a map's vertices, for a scene ``in_media`` or without media. Mitsuba's types belong to a variant."""

    @dataclass
    class Vertices:
        """Vertices of light paths: 13 words each."""

        p: mi.Point3f
        n: mi.Normal3f  # geometric; 0 where light scatters in a medium
        d: mi.Vector3f  # direction of the light that arrives
        β: mi.Spectrum  # power of the light that arrives, times the number of light paths
        depth: mi.UInt32  # edges from the light; 0 where nothing is gathered

        def __len__(self) -> int:
            return dr.width(self.depth)

    if not in_media:
        return Vertices

    @dataclass
    class VerticesInMedia(Vertices):
        """14 words each."""

        medium: mi.MediumPtr  # the medium around the vertex

    return VerticesInMedia


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
