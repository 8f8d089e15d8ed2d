r"""Gradients of photons in media: ``vpm``, and each photon that is gathered shifted to four neighbours.

    x, y        where a camera path scatters in a medium, and where the neighbouring pixel's path does
    b, b'       a photon in the ball around x and its copy in that around y
    C, C'       β f Φ / (4/3 π r³ N) of either, both with the density of the photon's path
    r           p' J / p of the copy
    Δ           gradient sample, the sum of 2 w (C' - C) over all photons, w = 1 / (1 + r)

A photon in both balls is its own copy: r = 1, and no ray is traced. One in that around x alone goes to its mirror image
in the plane between x and y, which is in the ball around y alone. (Gruson et al. call both together the mixed shift.)
The photon's predecessor stays, and a new edge is made from there: see ``shift`` and ``copies``.

Camera paths are shifted by replay, distances included, see ``camera_segments``. Where one path scatters in a medium
and the other meets a surface, no photon has a copy. Photons on surfaces are those of ``gpm``.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 4]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightRay
from data_gen.paths.shift import gradient_weight
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.gradients import shift
from data_gen.samplers.photons.gradients.camera import Path
from data_gen.samplers.photons.gradients.camera_segments import Flight, FlightLevel, levels_by_segments
from data_gen.samplers.photons.gradients.differences import (
    PAIR_BYTES,
    PAIRS,
    Near,
    add_to,
    chosen,
    differences,
    emitted,
    gradient_pass,
)
from data_gen.samplers.photons.gradients.pairs import Points
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.photon import Photon
from data_gen.samplers.photons.map.radius import shrunk
from data_gen.samplers.photons.media.bre import seen_along
from data_gen.samplers.photons.media.gbre import PATHS_BYTES, AlongPieces, Both, with_media
from data_gen.samplers.photons.media.vpm import VPM
from data_gen.samplers.photons.passes import Passes


@dataclass
class InBall:
    """A vertex of a camera path in a medium, which photons are gathered near to."""

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
        """The place of the copy near to the ``other`` of a photon that is near to this one alone."""
        return shift.image(p, self.p, other.p)

    def light(self, photon: Photon, distance2: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """β f Φ; the kernel is not in it."""
        seen = seen_along(mi.Ray3f(self.p, self.d), self.medium)
        f, _ = self.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(), seen, -photon.d, active)
        L = self.β * f * photon.Φ
        return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def ball_of(paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> InBall:
    """Where camera paths scatter; the path of number ``which``, if there is more than one."""
    return InBall(*chosen(fields_of, paths, which, index))


def fields_of(path: Flight, index: mi.UInt32) -> tuple:
    o, d = dr.gather(mi.Point3f, path.ray.o, index), dr.gather(mi.Vector3f, path.ray.d, index)
    known = (dr.gather(type(value), value, index) for value in (path.medium, path.β, path.alive & path.scatters))
    return o + d * dr.gather(mi.Float, path.hit.t, index), d, *known


class InBalls(AlongPieces):
    """The photons of a map in media, where they are gathered near to points, and where their light paths start."""

    receivers = staticmethod(ball_of)

    def __init__(self, fog: Fog, starts: LightRay, photons, radius: float, paths: int):
        super().__init__(starts, photons, radius, paths)
        self.Φ = fog.power(photons)
        dr.eval(self.Φ)

    @staticmethod
    def kernel(radius: float) -> tuple[float, float]:
        return radius, 4 / 3 * np.pi * radius**3

    def where(self, materials, base: Flight) -> tuple[Points, mi.Bool]:
        """Where base paths scatter, and whether they do."""
        return Points(base.ray(base.hit.t)), base.alive & base.scatters


class GVPM(VPM):
    """Gradients of photons in media and on surfaces.

    Plugin ``gvpm``. Parameters are those of ``gpm``; bias and what is not handled are those of ``vpm``.
    """

    name = "gvpm"
    pairs, camera_bytes = PAIRS, PATHS_BYTES + PAIRS * PAIR_BYTES

    def prepare(self, scene) -> SamplePass:
        return with_media(super().prepare(scene), self)

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        gradient_pass(self, passes, camera, film)

    def gathered(self, passes: Passes, starts: LightRay, photons, number: int, paths: int) -> Iterator:
        radius = self.radius * passes.width
        on_surfaces = Near(starts, photons, radius * shrunk(number), paths)
        yield Both(on_surfaces, InBalls(self.fog, starts, photons, radius * shrunk(number, 3), paths))

    def levels(self, passes: Passes, random, rays: list) -> Iterator:
        paths = passes.world.materials, random, rays, self.first_surface, self.behind_grids, self.hide_emitters
        return levels_by_segments(passes.world.scene, self.fog, *paths, self.max_depth, self.rr_depth, passes.frozen)

    def met(self, passes: Passes, level: FlightLevel, sums: list) -> mi.Spectrum:
        if not level.first:
            add_to(sums, level.lanes, passes.frozen(emitted, passes.world.scene, level.base, level.offsets))
            return mi.Spectrum(0)
        if level.behind:
            add_to(sums, level.lanes, passes.frozen(differences_behind, level.behind, level.offsets))
        return passes.frozen(self.seen_directly, passes.world.scene, *level.camera, fixed=True)

    def seen_directly(self, scene, ray: mi.Ray3f, importance) -> mi.Spectrum:
        """Lamps as seen through media."""
        return importance * self.lamps_in_fog(scene, self.fog.media, ray, self.fog.within, mi.UInt32(0))

    def parts(self, passes: Passes, near: Both, level: FlightLevel, most: int) -> Iterator[list]:
        longest = dr.opaque(mi.UInt32, self.max_depth) - level.depth
        base, *offsets = passes.frozen(ends, level.base, level.offsets)
        dr.eval(longest, base, offsets)
        yield from differences(passes, near.on_surfaces, base, offsets, longest, most)
        yield from differences(passes, near.in_media, level.base, level.offsets, longest, most)


def differences_behind(behind: list, offsets: list[Flight]) -> list:
    """Of what paths have seen behind grids, that of base paths and its four Δ."""
    C, *others = behind
    return [C, *(gradient_weight(mi.Float(1), y.alive) * (C1 - C) for y, C1 in zip(offsets, others, strict=True))]


def ends(base: Flight, offsets: list[Flight]) -> list[Path]:
    """All paths where they end at a surface, or nowhere."""
    return [path.on_surface() for path in (base, *offsets)]


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gvpm``, with the parameters of the scene's own ``volpath`` or ``path``."""
    return like_path(scene, "gvpm", **options).prepare(scene)


mi.register_integrator("gvpm", lambda props: GVPM(props))
