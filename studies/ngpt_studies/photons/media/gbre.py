r"""Gradients of the beam radiance estimate: ``bre``, and each photon that is gathered shifted to four neighbours.

    A, B        pieces of rays through a medium, of a camera path and of the neighbouring pixel's path
    b, b'       a photon beside A and its copy beside B: light path and camera path together make the path and its copy
    t, t'       the distances along A and B to where they are
    C, C'       β T(t) f Φ / (π r² N) of either, both with the density of the photon's path
    r, w, Δ     as in ``gpm``

A photon that is beside both is its own copy: r = 1, and no ray is traced. One that is beside only A keeps its distance
along the ray, and goes to its mirror image beside B: there A is further away than the radius. Between two rays from one
point this is a reflection, which maps what is beside only A to what is beside only B. The photon's predecessor stays,
and a new edge is made from there: see ``shift`` and ``copies``.

Camera paths are shifted by replay, see ``camera_in_media``. Photons on surfaces are as in ``gpm``.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.1]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.light_ends import World
from data_gen.samplers.photons.bre import BALL, seen_along
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import in_media
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.gpm import GPM, OnSurfaces
from ngpt_studies.photons.gradients import shift
from ngpt_studies.photons.gradients.camera_in_media import PathsByPieces, Piece
from ngpt_studies.photons.gradients.copies import LightPaths, copy_in_medium
from ngpt_studies.photons.gradients.differences import PAIR_BYTES, PAIRS, Gathered, chosen
from ngpt_studies.photons.gradients.pairs import Rays
from ngpt_studies.photons.map.vertices import Photon, photon_of
from ngpt_studies.photons.map.whole import MEDIA_MAP_BYTES, Traced

# Bytes of a camera sample beside pairs: levels of five pieces of paths, what they end at, and as many sums
PATHS_BYTES = 4096


@dataclass
class Beside:
    """A piece of a ray along which photons are gathered."""

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
        """Whether a photon may have its copy at this distance along the ray."""
        return t < self.length

    def image(self, p: mi.Point3f, other: Beside) -> mi.Point3f:
        """Where a photon that is near only to this ray has its copy, beside the ``other`` ray."""
        t = dr.dot(p - self.o, self.d)
        return shift.moved(p, self.at(t), self.d, other.at(t), other.d)

    def light(self, photon: Photon, t: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """β T(t) f Φ, without the kernel."""
        seen = seen_along(mi.Ray3f(self.o, self.d), self.medium)
        f, _ = self.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(), seen, -photon.d, active)
        L = self.β * dr.exp(-self.σ * t) * f * photon.Φ
        return dr.select(active & dr.isfinite(dr.sum(L)), L, 0)


def beside_of(near, world: World, pieces: list, which: mi.UInt32 | None, index: mi.UInt32) -> Beside:
    """``Near.receiver``: a piece of camera paths; of the path of number ``which``, if there is more than one."""
    return Beside(*chosen(fields_of, pieces, which, index))


def fields_of(piece: Piece, index: mi.UInt32) -> tuple:
    o, d = dr.gather(mi.Point3f, piece.ray.o, index), dr.gather(mi.Vector3f, piece.ray.d, index)
    hit = dr.gather(mi.PreliminaryIntersection3f, piece.hit, index)
    some = (piece.medium, piece.σ, piece.β, piece.alive)
    return o, d, hit.t, *(dr.gather(type(value), value, index) for value in some)


def inside_of(base: Piece) -> mi.Bool:
    return base.alive & (base.medium != None)  # noqa: E711 - an array of pointers


@dataclass
class InMedia:
    """``Near``, the common part for photons in media that are gathered near to points or beside rays. A receiver's
    ``near()`` says whether a photon is near, and its ``image()`` where the copy lies near to another receiver.
    """

    paths: LightPaths
    Φ: mi.Spectrum  # what counts of each photon's power
    grid: Grid
    radius2: mi.Float
    K: mi.Float  # of the kernel, over N

    def thing(self, place: mi.UInt32) -> Photon:
        photon = photon_of(self.paths.photons, dr.gather(mi.UInt32, self.grid.index, place))
        photon.Φ = dr.gather(mi.Spectrum, self.Φ, photon.place)
        return photon

    def brought(self, photon: Photon, A, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        t, near = A.near(photon.p, self.radius2)
        return A.light(photon, t, near & active & (photon.medium == A.medium)) * self.K, t

    def shared(self, photon: Photon, met: mi.Float, B, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        receives = lit & B.alive & (photon.medium == B.medium)
        t, shared = B.near(photon.p, self.radius2)
        shared &= receives
        apart = receives & ~shared & self.paths.shifts(photon.place) & B.reaches(met)
        return B.light(photon, t, shared) * self.K, apart

    def copied(self, world: World, photon: Photon, A, B) -> tuple[mi.Spectrum, mi.Float]:
        moved, t, r, good = copy_beside(world, self.paths, photon, A, B, self.radius2)
        return B.light(moved, t, good) * self.K, r


def copy_beside(world: World, paths: LightPaths, photon: Photon, A, B, radius2: mi.Float) -> tuple:
    """(copy, t', r, whether it exists) of the ``photon`` that is gathered at A and not at B."""
    target = A.image(photon.p, B)
    t, there = B.near(target, radius2)
    # The copy must not be near to A: the shift back would then take it as its own copy.
    there &= ~A.near(target, radius2)[1]
    moved, r, good = copy_in_medium(world, paths, photon, target, there)
    return moved, t, r, good & (photon.medium == B.medium)


class AlongPieces(InMedia):
    """``Near``: the photons of a map in media, beside rays."""

    receiver = beside_of

    def __init__(self, traced: Traced):
        photons, radius = traced.photons, traced.radius()
        grid = Grid(photons.p, in_media(photons), BALL * radius)
        K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * traced.paths))
        super().__init__(LightPaths(traced.starts, photons), photons.β, grid, dr.opaque(mi.Float, radius**2), K)

    def where(self, world: World, base: Piece) -> tuple[Rays, mi.Bool]:
        return Rays(mi.Ray3f(base.ray.o, base.ray.d), base.length()), inside_of(base)


class GBRE(GPM):
    """Gradients of the beam radiance estimate in homogeneous media, and of photons on surfaces.

    Plugin ``gbre``. Parameters: as for ``gpm``. Bias and what is not handled: as for ``bre``.
    """

    follows, walk, map_bytes = "volpath", PathsByPieces, MEDIA_MAP_BYTES
    camera_bytes = PATHS_BYTES + PAIRS * PAIR_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Gathered]:
        yield Gathered(OnSurfaces(traced), AlongPieces(traced))
