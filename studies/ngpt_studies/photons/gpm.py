r"""Gradient-domain photon mapping on surfaces: ``ppm``, and each photon that is gathered shifted to four neighbours.

    x, y        where photons are gathered: the vertices of a camera path and of the neighbouring pixel's path
    b, b'       a photon and its copy: light path and camera path together make the path, and its copy
    C, C'       f β Φ / (π r² N) of either, both with the density of the photon's path
    r           p' J / p of the copy
    Δ           gradient sample, the sum of 2 w (C' - C) over all photons, w = 1 / (1 + r)

A photon that is near to x and to y is its own copy: r = 1, and no ray is traced. With a radius of three pixels, four
photons of five are of this kind. Others go where ``shift`` has them, see ``copies``. Without a copy w = 1.

Camera paths are shifted by replay: see ``camera``. Emission that they meet behind mirrors and glass is shifted with
them; that which is seen directly is not part of the gradients.

[Hua et al. 2017, "Gradient-Domain Photon Density Estimation"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering",
section 4.3; Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 4]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import World
from data_gen.samplers.photons.integrator import PhotonIntegrator
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.radius import number_of, spread
from data_gen.samplers.photons.map.vertices import light, on_surfaces
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.gradients.camera import CameraPaths, Path
from ngpt_studies.photons.gradients.copies import LightPaths, copy
from ngpt_studies.photons.gradients.differences import (
    PAIR_BYTES,
    PAIRS,
    Gathered,
    GradientPasses,
    chosen,
    gradient_pass,
)
from ngpt_studies.photons.gradients.pairs import Points
from ngpt_studies.photons.map.trace import MAP_BYTES
from ngpt_studies.photons.map.vertices import Photon, is_near, photon_of
from ngpt_studies.photons.map.whole import GRID_BYTES, Traced, whole_maps

# Bytes of a camera sample beside that: levels of five paths with their rays, hits and throughputs, and as many sums
PATHS_BYTES = 3072


@dataclass
class AtVertex:
    x: mi.SurfaceInteraction3f
    β: mi.Spectrum
    receives: mi.Bool  # photons


@dataclass(init=False)
class OnSurfaces:
    """``Near``: the photons of a map on surfaces, and where their light paths come from."""

    paths: LightPaths
    grid: Grid
    radius2: mi.Float
    K: mi.Float  # of the kernel, over N
    number: mi.UInt32  # of the pass

    def __init__(self, traced: Traced):
        self.paths, radius = LightPaths(traced.starts, traced.photons), traced.radius()
        self.grid = Grid(traced.photons.p, on_surfaces(traced.photons), radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * traced.paths))
        self.number = number_of(traced.seed, traced.number)

    def where(self, world: World, base: Path) -> tuple[Points, mi.Bool]:
        x = base.vertex()
        return Points(mi.Point3f(x.p)), base.alive & x.is_valid() & world.materials.connectable(x.bsdf())

    def receiver(self, world: World, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> AtVertex:
        o, d, hit, β, alive = chosen(fields_of, paths, which, index)
        x = hit.compute_surface_interaction(mi.Ray3f(o, d))
        return AtVertex(x, β, alive & x.is_valid() & world.materials.connectable(x.bsdf()))

    def spread(self, world: World, path: Path) -> Path:
        """The path, its β times its own π r² / A."""
        x = path.vertex()
        receives = path.alive & x.is_valid() & world.materials.connectable(x.bsdf())
        return replace(path, β=path.β * spread(world, x, self.radius2, self.number, receives))

    def thing(self, place: mi.UInt32) -> Photon:
        return photon_of(self.paths.photons, dr.gather(mi.UInt32, self.grid.index, place))

    def brought(self, photon: Photon, A: AtVertex, active: mi.Bool) -> tuple[mi.Spectrum, None]:
        return self.light(photon, A, active & is_near(photon, A.x, self.radius2)), None

    def shared(self, photon: Photon, met: None, B: AtVertex, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        receives = lit & B.receives
        shared = receives & is_near(photon, B.x, self.radius2)
        return self.light(photon, B, shared), receives & ~shared & self.paths.shifts(photon.place)

    def copied(self, world: World, photon: Photon, A: AtVertex, B: AtVertex) -> tuple[mi.Spectrum, mi.Float]:
        everywhere = dr.full(mi.Bool, True, dr.width(photon.place))
        moved, r, good = copy(world, self.paths, photon, (A.x, B.x), self.radius2, everywhere)
        return self.light(moved, B, good), r

    def light(self, photon: Photon, at: AtVertex, active: mi.Bool) -> mi.Spectrum:
        return at.β * light(photon, at.x, at.x.bsdf(), active) * self.K


def fields_of(path: Path, index: mi.UInt32) -> tuple:
    o, d = dr.gather(mi.Point3f, path.ray.o, index), dr.gather(mi.Vector3f, path.ray.d, index)
    hit, β = dr.gather(mi.PreliminaryIntersection3f, path.hit, index), dr.gather(mi.Spectrum, path.β, index)
    return o, d, hit, β, dr.gather(mi.Bool, path.alive, index)


class GPM(PhotonIntegrator):
    """Gradient-domain photon mapping on surfaces.

    Plugin ``gpm``. Parameters: as for ``ppm``, and

    ``diagnostics``  false; true adds the layer ``shift_failures``, the share in [0, 1] of the photons gathered at a
                     pixel that have no copy

    Not handled: what ``ppm`` does not handle. Photons that come through glass have no copies but themselves.
    """

    # How camera paths go side by side, and how many pairs are in memory together for each camera sample
    walk, pairs, edges = CameraPaths, PAIRS, False
    camera_bytes, map_bytes, grid_bytes = PATHS_BYTES + PAIRS * PAIR_BYTES, MAP_BYTES, GRID_BYTES

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> GradientPasses:
        passes = super().begin(scene, sensor)
        return GradientPasses(self, passes.world, passes.width, self.walk(self, passes.world))

    def maps(self, passes: Passes, camera: CameraSamples) -> Iterator[Traced]:
        return whole_maps(self, passes, camera, self.edges)

    def sample_pass(self, passes: GradientPasses, camera: CameraSamples, film: GradientFilm) -> None:
        gradient_pass(passes, camera, film, self.near, self.pairs)

    def near(self, passes: Passes, traced: Traced) -> Iterator[Gathered]:
        """Yields the things near to camera paths in a photon map, one part after another."""
        yield Gathered(OnSurfaces(traced))
