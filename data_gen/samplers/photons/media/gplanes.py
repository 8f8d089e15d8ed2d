r"""Gradients of photon planes: ``planes``, and each plane that a camera ray meets shifted to four neighbours.

    A, B        a piece of a camera path's ray through a medium, along w, and that of the neighbouring pixel's path
    a, d, e     a plane: where the edge enters the medium, its direction, and that of the scattered light
    s, t, u     distances on the edge, from there to the point of the plane that is on A, and along A
    e', s', t'  of the copy, whose point on B is as far along B: u' = u
    C, C'       of the plane and its copy, both with the density of the plane's path: see ``planes``
    J           dω'/dω = (t / t') |d · (e' × w')| / |d · (e × w)| of the directions e and e'
    r           p(e') J / p(e)

The plane turns about its edge, up to the point on B. The angle between d and e stays, so phase functions and their
densities do. Shifting the copy back gives the plane. What 1 / |d · (e × w)| has of noise, where rays graze a plane,
falls out: C' has it of A.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.3; its eq. 18 is in a local frame
of the plane, and is not J: J is checked by finite differences]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS
from data_gen.passes import SamplePass
from data_gen.paths.light_ends import LightRay
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.gradients import shift
from data_gen.samplers.photons.gradients.camera_in_media import Piece
from data_gen.samplers.photons.gradients.differences import difference
from data_gen.samplers.photons.gradients.pairs import Pairs
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.photon import Photon
from data_gen.samplers.photons.map.trace import VERTICES_PER_PATH
from data_gen.samplers.photons.media.bre import seen_along
from data_gen.samplers.photons.media.gbeams import GBEAMS
from data_gen.samplers.photons.media.gbre import Beside, Both, beside_of
from data_gen.samplers.photons.media.planes import (
    PLANE_BYTES,
    AcrossPlanes,
    Crossing,
    crossing,
    only_beams,
    planes_of,
    scattered_of,
)
from data_gen.samplers.photons.passes import Passes


@dataclass
class RaysAcrossPlanes:
    """Pieces of rays, which planes are met by."""

    ray: mi.Ray3f
    length: mi.Float
    planes: AcrossPlanes

    def each(self, grid: Grid | None, radius2: mi.Float | None, active: mi.Bool, visit, state: tuple) -> tuple:
        return self.planes.each(self.ray, self.length, active, visit, state)

    def __len__(self) -> int:
        return dr.width(self.length)


@dataclass
class NearPlanes:
    """The planes of a map, each of which may be met by each ray: no grid, no radius."""

    planes: AcrossPlanes
    grid: None = None
    radius2: None = None

    def where(self, materials, base: Piece) -> tuple[RaysAcrossPlanes, mi.Bool]:
        """The pieces of base paths, and whether there is a medium."""
        ray, inside = mi.Ray3f(base.ray.o, base.ray.d), base.medium != None  # noqa: E711 - an array of pointers
        return RaysAcrossPlanes(ray, base.length(), self.planes), base.alive & inside

    def of_pairs(self, materials, pairs: Pairs, base: Piece, offsets: list, longest: mi.UInt32) -> tuple:
        """Of each pair C, four Δ without a copy, and counts; and where a copy is to be looked for."""
        A, plane = beside_of([base], None, pairs.point), self.planes.plane(pairs.place)
        at = crossing(plane.a, plane.d, plane.e, A.o, A.d)
        short = plane.depth <= dr.gather(mi.UInt32, longest, pairs.point)
        C = self.light(plane, at, A, A.alive & short) / dr.abs(at.volume)
        C = dr.select(dr.isfinite(dr.sum(C)), C, 0)
        lit, none = dr.max(C) > 0, mi.Spectrum(0)
        Δ = [difference(C, none, mi.Float(1)) for _ in offsets]
        others = [beside_of([offset], None, pairs.point) for offset in offsets]
        apart = [lit & B.alive & (B.medium != None) & (at.u < B.length) for B in others]  # noqa: E711
        return [C, *Δ, mi.Point2f(dr.select(lit, len(SHIFTS), 0), 0)], apart

    def of_copies(
        self, scene, lights, materials, fog, pairs: Pairs, some: mi.UInt32, which: mi.UInt32, base, offsets: list, C
    ) -> mi.Spectrum:
        """Δ by the shift of number ``which`` of ``some`` pairs."""
        point, place = (dr.gather(mi.UInt32, index, some) for index in (pairs.point, pairs.place))
        A, B, plane = beside_of([base], None, point), beside_of(offsets, which, point), self.planes.plane(place)
        at = crossing(plane.a, plane.d, plane.e, A.o, A.d)
        moved, there, per_volume, r, good = copied(plane, at, B)
        C1 = self.light(moved, there, B, good) * per_volume
        return difference(dr.gather(mi.Spectrum, C, some), C1, r)

    def light(self, plane, at: Crossing, ray: Beside, active) -> mi.Spectrum:
        """What a plane brings to a ray, times |d · (e × w)|."""
        T = self.planes.transmitted(plane, at, ray.medium, active)
        σs = scattered_of(ray.medium, mi.Ray3f(ray.o, ray.d), active)
        photon = Photon(plane.a, mi.Normal3f(0), plane.e, plane.Φ * T * σs)
        return ray.light(photon, at.u, active)


def copied(plane, at: Crossing, B: Beside) -> tuple:
    """The copy of a ``plane``, met ``at`` a place, where B meets it, J / |d · (e' × w')|, r, and whether it exists.

    Whether anything is in its way is not known yet.
    """
    e, s, t = shift.about(plane.a, plane.d, plane.e, B.at(at.u))
    there = Crossing(s, t, at.u, dr.dot(plane.d, dr.cross(e, B.d)))
    J = shift.jacobian_of_planes(at.t, at.volume, t, there.volume)
    # The phase function where the edge scatters, from either direction to the other
    phase, seen = plane.medium.phase_function(), seen_along(mi.Ray3f(plane.a, plane.d), plane.medium)
    (f, p), (f1, p1) = (phase.eval_pdf(mi.PhaseFunctionContext(), seen, to) for to in (plane.e, e))
    known = plane.a, plane.d, e, plane.length, plane.Φ * (f1 / f), plane.σ, plane.medium, plane.depth
    good = B.alive & (at.u < B.length) & (s > 0) & (s < plane.length) & (t > 0)
    return type(plane)(*known), there, J / dr.abs(there.volume), J * p1 / p, good


class GPLANES(GBEAMS):
    """Gradients of photon planes in homogeneous media, and of beams and photons on surfaces.

    Plugin ``gplanes``. Parameters are those of ``gpm``, and ``planes``; see there for bias and what is not handled.
    """

    name = "gplanes"
    map_bytes = GBEAMS.map_bytes + VERTICES_PER_PATH * PLANE_BYTES

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.planes = self.options["planes"]

    def gathered(self, passes: Passes, starts: LightRay, photons, number: int, paths: int) -> Iterator:
        yield from super().gathered(passes, starts, only_beams(photons), number, paths)
        yield Both(None, NearPlanes(planes_of(passes, photons, paths)))


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gplanes``, with the parameters of the scene's own ``volpath`` or ``path``."""
    return like_path(scene, "gplanes", **options).prepare(scene)


mi.register_integrator("gplanes", lambda props: GPLANES(props))
