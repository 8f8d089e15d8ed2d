r"""Gradients of photons in media: ``vpm``, and each photon that is gathered shifted to four neighbours.

    x, y        where a camera path scatters in a medium, and where the neighbouring pixel's path does
    b, b'       a photon in the ball around x and its copy in that around y
    C, C'       β f Φ / (4/3 π r³ N) of either, both with the density of the photon's path
    r, w, Δ     as in ``gpm``

A photon in both balls is its own copy: r = 1, and no ray is traced. A photon only in the ball around x goes to its
mirror image in the plane between x and y, which is only in the ball around y. (Gruson et al. call both together the
mixed shift.) The photon's predecessor stays, and a new edge is made from there: see ``shift`` and ``copies``.

Camera paths are shifted by replay, distances included, see ``camera_segments``. Where one path scatters in a medium and
the other meets a surface, no photon has a copy. Photons on surfaces are as in ``gpm``.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 4]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.light_ends import World
from data_gen.samplers.photons.bre import seen_along
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import in_media
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.gpm import GPM, OnSurfaces
from ngpt_studies.photons.gradients import shift
from ngpt_studies.photons.gradients.camera_segments import Flight, PathsBySegments
from ngpt_studies.photons.gradients.copies import LightPaths
from ngpt_studies.photons.gradients.differences import PAIR_BYTES, PAIRS, Gathered, chosen
from ngpt_studies.photons.gradients.pairs import Points
from ngpt_studies.photons.map.vertices import Photon
from ngpt_studies.photons.map.whole import MEDIA_MAP_BYTES, Traced
from ngpt_studies.photons.media.gbre import PATHS_BYTES, InMedia


@dataclass
class InBall:
    """A vertex of a camera path in a medium, near which photons are gathered."""

    p: mi.Point3f
    d: mi.Vector3f
    medium: mi.MediumPtr
    β: mi.Spectrum
    alive: mi.Bool

    def near(self, p: mi.Point3f, radius2: mi.Float) -> tuple[mi.Float, mi.Bool]:
        """The squared distance of a point, and whether it is near enough."""
        distance2 = dr.squared_norm(p - self.p)
        return distance2, self.alive & (distance2 < radius2)

    def reaches(self, distance2: mi.Float) -> mi.Bool:
        """Whether a photon may have its copy here: any photon may."""
        return self.alive

    def image(self, p: mi.Point3f, other: InBall) -> mi.Point3f:
        """Where a photon that is near only to this vertex has its copy, near to the ``other``."""
        return shift.image(p, self.p, other.p)

    def light(self, photon: Photon, distance2: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """β f Φ, without the kernel."""
        seen = seen_along(mi.Ray3f(self.p, self.d), self.medium)
        f, _ = self.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(), seen, -photon.d, active)
        L = self.β * f * photon.Φ
        return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def fields_of(path: Flight, index: mi.UInt32) -> tuple:
    o, d = dr.gather(mi.Point3f, path.ray.o, index), dr.gather(mi.Vector3f, path.ray.d, index)
    known = (dr.gather(type(value), value, index) for value in (path.medium, path.β, path.alive & path.scatters))
    return o + d * dr.gather(mi.Float, path.hit.t, index), d, *known


class InBalls(InMedia):
    """``Near``: the photons of a map in media, near to points."""

    def __init__(self, fog: Fog, traced: Traced):
        photons, radius, Φ = traced.photons, traced.radius(3), fog.power(traced.photons)
        dr.eval(Φ)
        K = dr.opaque(mi.Float, 1 / (4 / 3 * np.pi * radius**3 * traced.paths))
        grid = Grid(photons.p, in_media(photons), radius)
        super().__init__(LightPaths(traced.starts, photons), Φ, grid, dr.opaque(mi.Float, radius**2), K)

    def where(self, world: World, base: Flight) -> tuple[Points, mi.Bool]:
        return Points(base.ray(base.hit.t)), base.alive & base.scatters

    def receiver(self, world: World, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> InBall:
        return InBall(*chosen(fields_of, paths, which, index))


class GVPM(GPM):
    """Gradients of photons in media and on surfaces.

    Plugin ``gvpm``. Parameters: as for ``gpm``. Bias and what is not handled: as for ``vpm``.
    """

    follows, walk, map_bytes = "volpath", PathsBySegments, MEDIA_MAP_BYTES
    camera_bytes = PATHS_BYTES + PAIRS * PAIR_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Gathered]:
        yield Gathered(OnSurfaces(traced), InBalls(passes.world.fog, traced))
