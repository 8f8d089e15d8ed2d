r"""Gradients of photon beams: ``beams``, and each beam that is gathered shifted to four neighbours.

    A, B        pieces of rays through a medium, of a camera path and of the neighbouring pixel's path
    s, t, u     distances along a beam and along A to where both are nearest, and how far they are apart there, signed
    a           where the beam begins, a vertex of its light path or the point of a lamp
    C, C'       of a beam and its copy, both with the density of the beam's path: see ``beams``
    J           dω'/dω = (sin θ' / sin θ) (s / s')² of the directions at a, θ: between beam and ray
    r           p' J / p of the copy, T_c among the densities

A beam that is near to both rays is its own copy. One that is near only to A turns about a: it passes B at the same
distance t, on the other side, at -u. So A, which it passes about as far off as the beam passes B, is not near.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.2]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import World
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import at
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.gpm import GPM, OnSurfaces
from ngpt_studies.photons.gradients import shift
from ngpt_studies.photons.gradients.camera_in_media import PathsByPieces, Piece
from ngpt_studies.photons.gradients.copies import LightPaths, let_through, redirected
from ngpt_studies.photons.gradients.differences import PAIR_BYTES, Gathered
from ngpt_studies.photons.map.vertices import Photon
from ngpt_studies.photons.map.whole import Traced
from ngpt_studies.photons.media.beams import BEAM_BYTES, PART_BYTES, AlongBeams, nearest, parts_of
from ngpt_studies.photons.media.gbre import PATHS_BYTES, Beside, beside_of, inside_of

# Parts of beams, for each light path, and pairs of a ray and a beam, for each camera sample, in memory together
PARTS = 16
PAIRS = 8


@dataclass
class Line:
    """The line of a beam: ``p`` is on it."""

    p: mi.Point3f
    d: mi.Vector3f
    back: mi.Float  # from p to where the beam begins

    def past(self, ray: Beside, radius: mi.Float) -> Meeting:
        s, t, aside, sin = nearest(ray.o, ray.d, self.p, self.d)
        near = ray.alive & (aside < radius) & (t > 0) & (t < ray.length) & (s > -self.back)
        return Meeting(s, t, sin, near)


@dataclass
class Meeting:
    """Where a beam passes a ray."""

    s: mi.Float  # along the beam, from ``Line.p``
    t: mi.Float
    sin: mi.Float
    near: mi.Bool  # to the ray, between the ends of the ray, and behind where the beam begins


@dataclass
class Beam:
    """A beam whose ``part`` is near to a ray; p of its line is the middle of the part."""

    line: Line
    part: Any  # ``beams.parts_class``

    @property
    def depth(self) -> mi.UInt32:
        return self.part.depth


@dataclass
class RaysAmong:
    """Pieces of rays among things that each of them may be near to."""

    ray: mi.Ray3f
    length: mi.Float
    things: Any  # beams or planes

    def each(self, grid: Grid | None, radius2: mi.Float | None, active: mi.Bool, visit, state: tuple) -> tuple:
        return self.things.each(self.ray, self.length, active, visit, state)

    def __len__(self) -> int:
        return dr.width(self.length)


@dataclass
class NearBeams:
    """``Near``: the beams of a map beside rays, and where their light paths come from."""

    paths: LightPaths
    beams: AlongBeams
    grid: Grid
    radius2: mi.Float

    receiver = beside_of

    def where(self, world: World, base: Piece) -> tuple[RaysAmong, mi.Bool]:
        return RaysAmong(mi.Ray3f(base.ray.o, base.ray.d), base.length(), self.beams), inside_of(base)

    def thing(self, place: mi.UInt32) -> Beam:
        part = at(self.beams.parts, dr.gather(mi.UInt32, self.grid.index, place))
        back = dr.dot(part.p - dr.gather(mi.Point3f, self.paths.photons.o, part.edge), part.d)
        return Beam(Line(part.p, part.d, back), part)

    def brought(self, beam: Beam, A: Beside, active: mi.Bool) -> tuple[mi.Spectrum, Meeting]:
        met = beam.line.past(A, self.beams.radius)
        return self.light(beam, met, A, met.near & active & (beam.part.medium == A.medium)), met

    def shared(self, beam: Beam, met: Meeting, B: Beside, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        receives = lit & B.alive & (beam.part.medium == B.medium)
        other = beam.line.past(B, self.beams.radius)
        # Where it passes, the beam must be in the medium, and must not have ended.
        shared = receives & other.near & (other.s >= -beam.part.before) & (other.s < beam.part.after)
        apart = receives & ~other.near & self.paths.shifts(beam.part.edge) & (met.t < B.length)
        return self.light(beam, other, B, shared), apart

    def copied(self, world: World, beam: Beam, A: Beside, B: Beside) -> tuple[mi.Spectrum, mi.Float]:
        moved, t, r, good = turned(world, self.paths, beam, A, B, self.beams.radius)
        return B.light(moved, t, good & (beam.part.medium == B.medium)) * self.beams.K, r

    def light(self, beam: Beam, met: Meeting, ray: Beside, active: mi.Bool) -> mi.Spectrum:
        Φ = beam.part.Φ * dr.exp(-beam.part.σ * met.s) / met.sin
        return ray.light(Photon(beam.line.p, mi.Normal3f(0), beam.line.d, Φ), met.t, active) * self.beams.K


def turned(world: World, paths: LightPaths, beam: Beam, A: Beside, B: Beside, radius: mi.Float) -> tuple:
    """(copy, t', r, whether it exists) of the ``beam`` that is near to A and not to B.

    The copy is a photon where the beam passes B, of power 1 / sin θ' times as much.
    """
    photons, line, edge = paths.photons, beam.line, beam.part.edge
    # ------------------- Where the beam passes A, and how far aside -------------------
    met = line.past(A, radius)
    x, y, foot = A.at(met.t), B.at(met.t), line.p + line.d * met.s
    colour = dr.gather(mi.UInt32, photons.colour, edge)
    photon = Photon(foot, mi.Normal3f(0), line.d, mi.Spectrum(0), place=edge, medium=beam.part.medium, channel=colour)
    u = dr.dot(foot - x, dr.normalize(dr.cross(A.d, line.d)))

    # ------------------- As far on the other side of B, from the same a ---------------
    start = dr.gather(mi.UInt32, photons.parent, edge)
    first = dr.gather(mi.Float, photons.density, edge) == 0
    far = first & world.lights.far(dr.gather(mi.UInt32, paths.starts.index, start, first))
    target = shift.past(dr.gather(mi.Point3f, photons.o, edge), line.d, y, B.d, -u, far)
    way = redirected(world, paths, photon, foot, target, True)
    reach = dr.dot(target - way.ray.o, way.ray.d)
    copy = Line(target, way.ray.d, reach)
    other = copy.past(B, radius)
    J = (other.sin / met.sin) * shift.jacobian_in_medium(way.base_length2, way.length2)
    r = way.ratio * J
    good = other.near & way.leads(target, r)
    # The copy must not be near to A: the shift back would then take it as its own copy.
    good &= ~copy.past(A, radius).near

    # ------------------- What comes through, and is scattered there -------------------
    passage = let_through(world, way, good, target)
    good &= ~passage.met.is_valid() & (passage.medium == beam.part.medium)
    here = dr.zeros(mi.MediumInteraction3f, dr.width(reach))
    here.p, here.wavelengths, here.medium = target, way.ray.wavelengths, passage.medium
    σs, _, _ = passage.medium.get_scattering_coefficients(here, good)
    Φ = dr.select(good, way.Φ * σs * (J * passage.T) / other.sin, 0)
    return Photon(target, mi.Normal3f(0), way.ray.d, Φ), other.t, r * passage.T_c, good


class GBEAMS(GPM):
    """Gradients of photon beams in homogeneous media, and of photons on surfaces.

    Plugin ``gbeams``. Parameters: as for ``gpm``. Bias and what is not handled: as for ``beams``.
    """

    follows, walk, edges, pairs = "volpath", PathsByPieces, True, PAIRS
    map_bytes, camera_bytes = BEAM_BYTES + PARTS * PART_BYTES, PATHS_BYTES + PAIRS * PAIR_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Gathered]:
        on_surfaces: OnSurfaces | None = OnSurfaces(traced)
        radius2 = dr.opaque(mi.Float, traced.radius(1) ** 2)
        for parts in parts_of(passes, traced, PARTS * traced.paths):
            beams, paths = AlongBeams(parts, traced, self.limits.max_depth), LightPaths(traced.starts, traced.photons)
            yield Gathered(on_surfaces, NearBeams(paths, beams, beams.grid, radius2))
            on_surfaces = None
