r"""Gradients of the beam radiance estimate: ``bre``, and each photon that is gathered shifted to four neighbours.

    A, B        a piece of a camera path's ray through a medium, and that of the neighbouring pixel's path
    b, b'       a photon beside A and its copy beside B: light path and camera path together make the path and its copy
    t, t'       the distances along A and B to where they are
    C, C'       β T(t) f Φ / (π r² N) of either, both with the density of the photon's path
    r           p' J / p of the copy
    Δ           gradient sample, the sum of 2 w (C' - C) over all photons, w = 1 / (1 + r)

A photon that is beside both is its own copy: r = 1, and no ray is traced. One that is beside A alone keeps its distance
along the ray, and goes to its mirror image beside B: there A is further away than the radius. Between two rays from one
point that is a reflection, which maps what is beside A alone to what is beside B alone. The photon's predecessor stays,
and a new edge is made from there: see ``shift`` and ``copies``.

Camera paths are shifted by replay, see ``camera_in_media``. Photons on surfaces are those of ``gpm``.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.1]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightRay
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.gradients import shift
from data_gen.samplers.photons.gradients.camera import Level
from data_gen.samplers.photons.gradients.camera_in_media import Piece, ends, levels_in_media
from data_gen.samplers.photons.gradients.copies import copy_in_medium
from data_gen.samplers.photons.gradients.differences import (
    PAIR_BYTES,
    PAIRS,
    Near,
    add_to,
    chosen,
    difference,
    differences,
    emitted,
    gradient_pass,
)
from data_gen.samplers.photons.gradients.pairs import Pairs, Rays
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.photon import Photon, photon_of
from data_gen.samplers.photons.map.radius import shrunk
from data_gen.samplers.photons.media.bre import BALL, BRE, seen_along
from data_gen.samplers.photons.passes import Passes
from ngpt.errors import NgptError

# Of a camera sample beside pairs: levels of five pieces of paths, what they end at, and as many sums
PATHS_BYTES = 4096


@dataclass
class Beside:
    """A piece of a ray that photons are gathered along."""

    o: mi.Point3f
    d: mi.Vector3f
    length: mi.Float
    medium: mi.MediumPtr
    σ: mi.Spectrum
    β: mi.Spectrum
    alive: mi.Bool

    def at(self, t: mi.Float) -> mi.Point3f:
        return self.o + self.d * t

    def near(self, p: mi.Point3f, radius2: mi.Float) -> tuple[mi.Float, mi.Bool]:
        """The distance to where the point is beside the ray, and whether it is near enough, and not beyond its ends."""
        t = dr.dot(p - self.o, self.d)
        return t, self.alive & (t > 0) & (t < self.length) & (dr.squared_norm(p - self.at(t)) < radius2)

    def reaches(self, t: mi.Float) -> mi.Bool:
        """Whether a photon may have its copy at that distance."""
        return t < self.length

    def image(self, p: mi.Point3f, other: Beside) -> mi.Point3f:
        """The place of the copy beside the ``other`` of a photon that is near to this ray alone."""
        t = dr.dot(p - self.o, self.d)
        return shift.moved(p, self.at(t), self.d, other.at(t), other.d)

    def light(self, photon: Photon, t: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """β T(t) f Φ; the kernel is not in it."""
        seen = seen_along(mi.Ray3f(self.o, self.d), self.medium)
        f, _ = self.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(), seen, -photon.d, active)
        L = self.β * dr.exp(-self.σ * t) * f * photon.Φ
        return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def beside_of(pieces: list, which: mi.UInt32 | None, index: mi.UInt32) -> Beside:
    """A piece of camera paths; of the path of number ``which``, if there is more than one."""
    return Beside(*chosen(fields_of, pieces, which, index))


def fields_of(piece: Piece, index: mi.UInt32) -> tuple:
    o, d = dr.gather(mi.Point3f, piece.ray.o, index), dr.gather(mi.Vector3f, piece.ray.d, index)
    hit = dr.gather(mi.PreliminaryIntersection3f, piece.hit, index)
    some = (piece.medium, piece.σ, piece.β, piece.alive)
    length = dr.select(hit.is_valid(), hit.t, dr.inf)
    return o, d, length, *(dr.gather(type(value), value, index) for value in some)


@dataclass(init=False)
class AlongPieces:
    """The photons of a map in media, where they are gathered along rays, and where their light paths start.

    ``receivers`` (paths, which, index) are what photons are near to, of those paths.
    """

    starts: LightRay
    photons: Any
    Φ: mi.Spectrum
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    receivers = staticmethod(beside_of)

    def __init__(self, starts: LightRay, photons, radius: float, paths: int):
        self.starts, self.photons, self.Φ = starts, photons, photons.β
        reach, volume = self.kernel(radius)
        scattered = (photons.depth > 0) & (dr.squared_norm(photons.n) == 0)
        self.grid = Grid(photons.p, scattered, reach)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (volume * paths))

    @staticmethod
    def kernel(radius: float) -> tuple[float, float]:
        """The radius that the grid is for, and what photons are counted in: here a disk."""
        return BALL * radius, np.pi * radius**2

    def where(self, materials, base: Piece) -> tuple[Rays, mi.Bool]:
        """The pieces of base paths, and whether there is a medium."""
        ray, inside = mi.Ray3f(base.ray.o, base.ray.d), base.medium != None  # noqa: E711 - an array of pointers
        return Rays(ray, base.length()), base.alive & inside

    def of_pairs(self, materials, pairs: Pairs, base: Piece, offsets: list, longest: mi.UInt32) -> tuple:
        """Of each pair C, four Δ with the photon for its copy, and counts; and where a copy is to be looked for."""
        j = dr.gather(mi.UInt32, self.grid.index, pairs.place)
        photon = photon_of(self.photons, j)
        photon.Φ = dr.gather(mi.Spectrum, self.Φ, j)
        short = dr.gather(mi.UInt32, self.photons.depth, j) <= dr.gather(mi.UInt32, longest, pairs.point)
        direct = dr.isfinite(dr.gather(mi.Float, self.photons.density, j))
        A = self.receivers([base], None, pairs.point)
        t, near = A.near(photon.p, self.radius2)
        C = A.light(photon, t, near & short & (photon.medium == A.medium)) * self.K
        lit = dr.max(C) > 0
        Δ, apart = [], []
        for offset in offsets:
            B = self.receivers([offset], None, pairs.point)
            receives = lit & B.alive & (photon.medium == B.medium)
            t1, shared = B.near(photon.p, self.radius2)
            shared &= receives
            Δ.append(difference(C, B.light(photon, t1, shared) * self.K, mi.Float(1)))
            apart.append(receives & ~shared & direct & B.reaches(t))
        return [C, *Δ, mi.Point2f(dr.select(lit, len(SHIFTS), 0), 0)], apart

    def of_copies(
        self, scene, lights, materials, fog, pairs: Pairs, some: mi.UInt32, which: mi.UInt32, base, offsets: list, C
    ) -> mi.Spectrum:
        """Δ by the shift of number ``which`` of ``some`` pairs, whose photons are beside the base path alone."""
        point, place = (dr.gather(mi.UInt32, index, some) for index in (pairs.point, pairs.place))
        j, C = dr.gather(mi.UInt32, self.grid.index, place), dr.gather(mi.Spectrum, C, some)
        A, B = self.receivers([base], None, point), self.receivers(offsets, which, point)
        photon = photon_of(self.photons, j)
        moved, t, r, good = copy_beside(scene, fog, lights, self.starts, self.photons, j, photon, A, B, self.radius2)
        return difference(C, B.light(moved, t, good) * self.K, r)


def copy_beside(scene, fog, lights, starts: LightRay, photons, j, photon: Photon, A: Beside, B: Beside, radius2):
    """(copy, t', r, whether it exists) of the ``photon`` of place ``j`` that is gathered at A and not at B."""
    target = A.image(photon.p, B)
    t1, there = B.near(target, radius2)
    # At A it would be gathered as it is, not as a copy: the shift back would be another.
    there &= ~A.near(target, radius2)[1]
    moved, r, good = copy_in_medium(scene, fog, lights, starts, photons, j, photon, target, there)
    return moved, t1, r, good & (photon.medium == B.medium)


@dataclass
class Both:
    """Photons on surfaces, and photons in media."""

    on_surfaces: Near | None
    in_media: Any


class GBRE(BRE):
    """Gradients of the beam radiance estimate in homogeneous media, and of photons on surfaces.

    Plugin ``gbre``. Parameters are those of ``gpm``; bias and what is not handled are those of ``bre``.
    """

    name = "gbre"
    grids = False
    pairs, camera_bytes = PAIRS, PATHS_BYTES + PAIRS * PAIR_BYTES

    def prepare(self, scene) -> SamplePass:
        return with_media(super().prepare(scene), self)

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        gradient_pass(self, passes, camera, film)

    def gathered(self, passes: Passes, starts: LightRay, photons, number: int, paths: int) -> Iterator:
        near = starts, photons, self.radius * passes.width * shrunk(number), paths
        yield Both(Near(*near), AlongPieces(*near))

    def levels(self, passes: Passes, random, rays: list) -> Iterator:
        paths = passes.world.materials, random, rays, self.first_surface, self.hide_emitters
        return levels_in_media(passes.world.scene, self.fog, *paths, self.max_depth, self.rr_depth, passes.frozen)

    def met(self, passes: Passes, level: Level, sums: list) -> mi.Spectrum:
        if not level.first:
            pieces = level.depth, level.base, level.offsets
            add_to(sums, level.lanes, passes.frozen(emitted_later, passes.world.scene, self.fog, *pieces))
            return mi.Spectrum(0)
        return passes.frozen(self.seen_directly, passes.world.scene, level.base, fixed=True)

    def seen_directly(self, scene, base: Piece) -> mi.Spectrum:
        """Lamps as seen through media."""
        ray = mi.Ray3f(base.ray)
        return base.β * self.lamps_in_fog(scene, self.fog.media, ray, self.fog.within, mi.UInt32(0))

    def parts(self, passes: Passes, near, level: Level, most: int) -> Iterator[list]:
        longest = dr.opaque(mi.UInt32, self.max_depth) - level.depth
        base, *offsets = passes.frozen(ends, self.fog, level.base, level.offsets)
        dr.eval(longest, base, offsets)
        if near.on_surfaces is not None:
            yield from differences(passes, near.on_surfaces, base, offsets, longest, most)
        yield from differences(passes, near.in_media, level.base, level.offsets, longest, most)


def with_media(passes: Passes, integrator) -> Passes:
    """The ``passes``; raises NgptError where there are no media."""
    if integrator.fog is None:
        raise NgptError(f"sampler '{integrator.name}' cannot render this scene: there are no media; use --sampler gpm")
    return passes


def emitted_later(scene, fog, depth: mi.UInt32, base: Piece, offsets: list) -> list:
    """What ``emitted`` has, of paths that have met a vertex."""
    paths = ends(fog, base, offsets)
    for path in paths:
        path.alive &= depth > 1
    return emitted(scene, paths[0], paths[1:])


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gbre``, with the parameters of the scene's own ``volpath`` or ``path``."""
    return like_path(scene, "gbre", **options).prepare(scene)


mi.register_integrator("gbre", lambda props: GBRE(props))
