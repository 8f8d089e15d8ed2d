"""The map of the light paths of a pass, and merging: gathering its photons at camera paths.

All photons within the radius r are gathered at z, the last vertex of a camera path, whichever light path they belong
to. Each photon completes a path. The density of this path is η = π r² N times the product of the densities of its
camera path and its light path, where N is the number of light paths in the pass. So ``mis`` can weight the merge
against all connections that make the same path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.light_path import LightPath, Seen, Visitor
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.vertex import RADIANCE, Vertex, evaluate, record_class
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.radius import spread
from data_gen.samplers.photons.map.trace import empty_map
from data_gen.samplers.photons.map.vertices import Photon, at, faces, put

# Bytes of a vertex: 23 words of a record, a word that says whether it is a photon, and 12 words while the grid is made.
VERTEX_BYTES = (23 + 1 + 12) * 4


@dataclass
class Map:
    """The vertices of light paths. The vertex at depth d of path i is at place i * ``size`` + d - 1."""

    vertices: Any  # ``record_class``
    photon: mi.UInt32  # 1 where photons are gathered
    first: mi.UInt32  # the place of each path's first vertex
    count: mi.UInt32  # the number of vertices of each path

    @classmethod
    def empty(cls, paths: int, size: int) -> Map:
        """An empty map for this number of light paths of at most ``size`` vertices."""
        vertices, first, _ = empty_map(record_class(mi.variant()), paths, size)
        found = cls(vertices, dr.zeros(mi.UInt32, paths * size), first, dr.zeros(mi.UInt32, paths))
        dr.make_opaque(found)
        return found

    def paths(self) -> LightPath:
        return LightPath(Reader(self), self.count)


class Reader:
    """Reads the vertices of each lane's own light path, as ``bdpt`` does. It is not part of the state of a loop."""

    def __init__(self, kept: Map):
        self.kept = kept

    def read(self, i: mi.UInt32):
        return at(self.kept.vertices, self.kept.first + i)


class Keeper:
    """Splats the connections of a light path to the camera, as ``bdpt`` does, and keeps its vertices in a map."""

    def __init__(self, splatter: Visitor, η: mi.Float, kept: Map):
        self.splatter, self.η, self.kept = splatter, η, kept

    def start(self) -> Any:
        return self.splatter.start()

    def sees(self, state: Any, seen: Seen) -> Any:
        place, here = self.kept.first + seen.y.depth - 1, seen.kept.depth > 0
        put(self.kept.vertices, seen.kept, place, here)
        # Where photons are gathered, ``Plan.known`` has set vcm to η.
        photon = dr.select(seen.y.end.vcm == self.η, mi.UInt32(1), 0)
        dr.scatter(self.kept.photon, photon, place, here)
        return self.splatter.sees(state, seen)


@dataclass(init=False)
class Photons:
    """The photons of a map of ``paths`` light paths, to be gathered within ``radius``."""

    kept: Map
    grid: Grid
    radius2: mi.Float
    K: mi.Float  # the kernel, 1 / η
    η: mi.Float
    number: mi.UInt32  # of the pass

    def __init__(self, kept: Map, radius: float, paths: int, number: mi.UInt32):
        self.kept, self.number, vertices = kept, number, kept.vertices
        exist = (vertices.depth > 0) & (kept.photon > 0)
        self.grid = Grid(mi.Point3f(vertices.o + vertices.d * vertices.t), exist, radius)
        self.radius2, self.η = dr.opaque(mi.Float, radius**2), dr.opaque(mi.Float, eta(radius, paths))
        self.K = dr.opaque(mi.Float, 1 / eta(radius, paths))


class Merging:
    """``Merges`` of ``bdpt``. A camera path and a photon merge if together they have at most ``plan.longest`` edges."""

    def __init__(self, photons: Photons, plan: Plan):
        self.photons, self.plan, self.materials, self.longest = photons, plan, plan.materials, plan.longest

    def light(self, z: Vertex, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Spectrum:
        """The weighted light of the photons near the vertex ``z``."""
        photons, active = self.photons, active & self.materials.connectable(bsdf)

        def one(i, near):
            photon, end, near = self.photon(i, z, near)
            C, others = self.merged(z, bsdf, photon, end, near)
            C /= 1 + others
            return dr.select(near & dr.isfinite(dr.sum(C)), C, 0)

        zero = dr.zeros(mi.Spectrum, dr.width(z.depth))
        L = photons.grid.gather(z.si.p, photons.radius2, active, one, zero)
        return photons.K * L * self.spread(z.si, active & (dr.max(L) > 0))

    def spread(self, x: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """A factor of the kernel K at ``x``: near edges, photons lie on less area. MIS weights do not include it."""
        return spread(self.plan, x, self.photons.radius2, self.photons.number, active)

    def photon(self, i: mi.UInt32, z: Vertex, near: mi.Bool) -> tuple[Photon, Partial, mi.Bool]:
        """The photon at place ``i`` of the grid, its partial sums, and whether it is gathered at ``z``."""
        grid, vertices = self.photons.grid, self.photons.kept.vertices
        j = dr.gather(mi.UInt32, grid.index, i, near)

        def its(name):
            value = getattr(vertices, name)
            return dr.gather(type(value), value, j, near)

        found = Photon(dr.gather(mi.Point3f, grid.p, i, near), its("n"), its("d"), its("β"))
        gathered = near & faces(found, z.si) & (its("depth") <= self.longest - z.depth)
        return found, Partial(its("vcm"), its("vc")), gathered

    def merged(self, z: Vertex, bsdf: mi.BSDFPtr, photon: Photon, end: Partial, active) -> tuple[mi.Spectrum, mi.Float]:
        """f / p of the path that a ``photon`` completes at ``z``, without the kernel, and ``others``."""
        g, p, q = brought(photon, z.si, bsdf, active)
        return z.β * g, mis.others_merged(z.end, q, end, p, self.photons.η)


def brought(photon: Photon, si, bsdf: mi.BSDFPtr, active) -> tuple[mi.Spectrum, mi.Float, mi.Float]:
    """Returns the radiance that a ``photon`` adds at ``si``, without the kernel, the density p of the direction to the
    light, and the density q of the direction to the camera.
    """
    f, p, q = evaluate(RADIANCE, si, bsdf, si.to_local(-photon.d), active)
    # f contains the shading cosine, but the density of photons follows the geometric one.
    return f * photon.Φ / dr.abs(dr.dot(photon.n, photon.d)), p, q


def eta(radius: float, paths: int) -> float:
    """Returns η of ``mis``: π r² N for N light ``paths``."""
    return float(np.pi * radius**2 * paths)
