r"""Gradients of photon planes: ``planes``, and each plane that a camera ray meets shifted to four neighbours.

    A, B        pieces of rays through a medium: A of a camera path, along w; B of the neighbouring pixel's path
    a, d, e     a plane: where the edge enters the medium, its direction, and the direction of the scattered light
    s, t, u     distances on the edge, from there to the point of the plane that is on A, and along A
    e', s', t'  of the copy, whose point on B is as far along B: u' = u
    C, C'       of the plane and its copy, both with the density of the plane's path: see ``planes``
    J           dω'/dω = (t / t') |d · (e' × w')| / |d · (e × w)| of the directions e and e'
    r           p(e') J / p(e)

The plane turns about its edge, up to the point on B. The angle between d and e stays, so phase functions and their
densities do. Shifting the copy back gives the plane. The noise of 1 / |d · (e × w)|, where rays graze a plane, cancels:
C' has the factor of A.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.3; its eq. 18 is in a local frame
of the plane, and is not J: J is checked by finite differences]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import World
from data_gen.samplers.photons.bre import seen_along
from data_gen.samplers.photons.map.trace import VERTICES_PER_PATH
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.gradients import shift
from ngpt_studies.photons.gradients.camera_in_media import Piece
from ngpt_studies.photons.gradients.differences import Gathered
from ngpt_studies.photons.map.vertices import Photon
from ngpt_studies.photons.map.whole import Traced
from ngpt_studies.photons.media.gbeams import GBEAMS, RaysAmong
from ngpt_studies.photons.media.gbre import Beside, beside_of, inside_of
from ngpt_studies.photons.media.planes import (
    PLANE_BYTES,
    AcrossPlanes,
    Crossing,
    crossing,
    only_beams,
    planes_of,
    scattered_of,
)


@dataclass
class NearPlanes:
    """``Near``: the planes of a map. Each ray may meet each plane: there is no grid and no radius."""

    planes: AcrossPlanes
    grid: None = None
    radius2: None = None

    receiver = beside_of

    def where(self, world: World, base: Piece) -> tuple[RaysAmong, mi.Bool]:
        return RaysAmong(mi.Ray3f(base.ray.o, base.ray.d), base.length(), self.planes), inside_of(base)

    def thing(self, place: mi.UInt32) -> Any:
        return self.planes.plane(place)

    def brought(self, plane, A: Beside, active: mi.Bool) -> tuple[mi.Spectrum, Crossing]:
        at = crossing(plane.a, plane.d, plane.e, A.o, A.d)
        C = self.light(plane, at, A, A.alive & active) / dr.abs(at.volume)
        return dr.select(dr.isfinite(dr.sum(C)), C, 0), at

    def shared(self, plane, met: Crossing, B: Beside, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        """No plane is its own copy."""
        inside = B.medium != None  # noqa: E711 - an array of pointers
        return mi.Spectrum(0), lit & B.alive & inside & (met.u < B.length)

    def copied(self, world: World, plane, A: Beside, B: Beside) -> tuple[mi.Spectrum, mi.Float]:
        at = crossing(plane.a, plane.d, plane.e, A.o, A.d)
        moved, there, per_volume, r, good = copied(plane, at, B)
        return self.light(moved, there, B, good) * per_volume, r

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
    good = B.alive & (at.u < B.length) & (s > 0) & (s < plane.length) & (t > 0)
    return replace(plane, e=e, Φ=plane.Φ * (f1 / f)), there, J / dr.abs(there.volume), J * p1 / p, good


class GPLANES(GBEAMS):
    """Gradients of photon planes in homogeneous media, and of beams and photons on surfaces.

    Plugin ``gplanes``. Parameters: as for ``gpm``, and ``planes``; see there for bias and what is not handled.
    """

    map_bytes = GBEAMS.map_bytes + VERTICES_PER_PATH * PLANE_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Gathered]:
        yield from super().near(passes, only_beams(traced))
        yield Gathered(None, NearPlanes(planes_of(passes, traced)))
