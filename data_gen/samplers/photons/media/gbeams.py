r"""Gradients of photon beams: ``beams``, and each beam that is gathered shifted to four neighbours.

    A, B        a piece of a camera path's ray through a medium, and that of the neighbouring pixel's path
    s, t, u     distances along a beam and along A to where both are nearest, and how far they are apart there, signed
    a           where the beam begins, a vertex of its light path or the point of a lamp
    C, C'       of a beam and its copy, both with the density of the beam's path: see ``beams``
    J           dω'/dω = (sin θ' / sin θ) (s / s')² of the directions at a, θ: between beam and ray
    r           p' J / p of the copy, T_c among the densities

A beam that is near to both rays is its own copy. One that is near to A alone turns about a: it passes B at the same
distance t, on the other side, at -u. So A, which it passes about as far off as the beam passes B, is not near.

[Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 5.2]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS
from data_gen.passes import SamplePass
from data_gen.paths.light_ends import LightRay
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.gradients import shift
from data_gen.samplers.photons.gradients.camera_in_media import Piece
from data_gen.samplers.photons.gradients.copies import let_through, redirected
from data_gen.samplers.photons.gradients.differences import PAIR_BYTES, Near, difference
from data_gen.samplers.photons.gradients.pairs import Pairs
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.photon import Photon
from data_gen.samplers.photons.map.radius import shrunk
from data_gen.samplers.photons.media.beams import BEAM_BYTES, PART_BYTES, AlongBeams, nearest, parts_of
from data_gen.samplers.photons.media.gbre import GBRE, PATHS_BYTES, Beside, Both, beside_of
from data_gen.samplers.photons.passes import Passes

# Parts of beams, for each light path, and pairs of a ray and a beam, for each camera sample, in memory together
PARTS = 16
PAIRS = 8


@dataclass
class Beam:
    """The line of a beam, ``p`` the middle of one of its parts; and where it passes a ray."""

    p: mi.Point3f
    d: mi.Vector3f
    back: mi.Float  # from there to where it begins
    s: mi.Float
    t: mi.Float
    sin: mi.Float
    passes: mi.Bool  # near to the ray, between the ends of the ray, and behind where the beam begins


def beam_past(ray: Beside, p, d, back, radius: mi.Float) -> Beam:
    s, t, aside, sin = nearest(ray.o, ray.d, p, d)
    near = ray.alive & (aside < radius) & (t > 0) & (t < ray.length) & (s > -back)
    return Beam(p, d, back, s, t, sin, near)


@dataclass
class RaysAmongBeams:
    """Pieces of rays, which beams are gathered along."""

    ray: mi.Ray3f
    length: mi.Float
    beams: AlongBeams

    def each(self, grid: Grid, radius2: mi.Float, active: mi.Bool, visit, state: tuple) -> tuple:
        return self.beams.each(self.ray, self.length, active, visit, state)

    def __len__(self) -> int:
        return dr.width(self.length)


@dataclass
class NearBeams:
    """The beams of a map, where they are gathered along rays, and where their light paths start."""

    starts: LightRay
    photons: Any
    beams: AlongBeams
    grid: Grid
    radius2: mi.Float

    def where(self, materials, base: Piece) -> tuple[RaysAmongBeams, mi.Bool]:
        """The pieces of base paths, and whether there is a medium."""
        ray, inside = mi.Ray3f(base.ray.o, base.ray.d), base.medium != None  # noqa: E711 - an array of pointers
        return RaysAmongBeams(ray, base.length(), self.beams), base.alive & inside

    def of_pairs(self, materials, pairs: Pairs, base: Piece, offsets: list, longest: mi.UInt32) -> tuple:
        """Of each pair C, four Δ with the beam for its copy, and counts; and where a copy is to be looked for."""
        parts, radius, K = self.beams.parts, self.beams.radius, self.beams.K
        j = dr.gather(mi.UInt32, self.grid.index, pairs.place)
        edge, medium = dr.gather(mi.UInt32, parts.edge, j), dr.gather(mi.MediumPtr, parts.medium, j)
        line = self.line(j, edge)
        before, after = dr.gather(mi.Float, parts.before, j), dr.gather(mi.Float, parts.after, j)
        Φ, falls = dr.gather(mi.Spectrum, parts.Φ, j), dr.gather(mi.Spectrum, parts.σ, j)
        short = dr.gather(mi.UInt32, parts.depth, j) <= dr.gather(mi.UInt32, longest, pairs.point)
        direct = dr.isfinite(dr.gather(mi.Float, self.photons.density, edge))

        def light(ray: Beside, beam: Beam, active):
            photon = Photon(beam.p, mi.Normal3f(0), beam.d, Φ * dr.exp(-falls * beam.s) / beam.sin)
            return ray.light(photon, beam.t, active) * K

        A = beside_of([base], None, pairs.point)
        beam = beam_past(A, *line, radius)
        C = light(A, beam, beam.passes & short & (medium == A.medium))
        lit = dr.max(C) > 0
        Δ, apart = [], []
        for offset in offsets:
            B = beside_of([offset], None, pairs.point)
            receives = lit & B.alive & (medium == B.medium)
            other = beam_past(B, *line, radius)
            # Where it passes, the beam must be in the medium, and must not have ended.
            shared = receives & other.passes & (other.s >= -before) & (other.s < after)
            Δ.append(difference(C, light(B, other, shared), mi.Float(1)))
            apart.append(receives & ~other.passes & direct & (beam.t < B.length))
        return [C, *Δ, mi.Point2f(dr.select(lit, len(SHIFTS), 0), 0)], apart

    def line(self, j: mi.UInt32, edge: mi.UInt32) -> tuple:
        """A point and the direction of a beam, and how far behind the point it begins."""
        p, d = dr.gather(mi.Point3f, self.beams.parts.p, j), dr.gather(mi.Vector3f, self.beams.parts.d, j)
        return p, d, dr.dot(p - dr.gather(mi.Point3f, self.photons.o, edge), d)

    def of_copies(
        self, scene, lights, materials, fog, pairs: Pairs, some: mi.UInt32, which: mi.UInt32, base, offsets: list, C
    ) -> mi.Spectrum:
        """Δ by the shift of number ``which`` of ``some`` pairs, whose beams are near to the base path alone."""
        point, place = (dr.gather(mi.UInt32, index, some) for index in (pairs.point, pairs.place))
        j, C = dr.gather(mi.UInt32, self.grid.index, place), dr.gather(mi.Spectrum, C, some)
        edge, medium = (
            dr.gather(mi.UInt32, self.beams.parts.edge, j),
            dr.gather(mi.MediumPtr, self.beams.parts.medium, j),
        )
        A, B = beside_of([base], None, point), beside_of(offsets, which, point)
        beam = beam_past(A, *self.line(j, edge), self.beams.radius)
        ends = scene, fog, lights, self.starts, self.photons, edge, medium
        moved, other, r, good = turned(*ends, beam, A, B, self.beams.radius)
        C1 = B.light(moved, other.t, good & (medium == B.medium)) * self.beams.K
        return difference(C, C1, r)


def turned(scene, fog, lights, starts: LightRay, photons, edge, medium, beam: Beam, A: Beside, B: Beside, radius):
    """(copy, its beam, r, whether it exists) of the ``beam`` of an ``edge`` that is near to A and not to B.

    The copy is a photon where the beam passes B, of power 1 / sin θ' times as much.
    """
    x, y = A.at(beam.t), B.at(beam.t)
    met = beam.p + beam.d * beam.s
    photon = Photon(met, mi.Normal3f(0), beam.d, mi.Spectrum(0), medium, dr.gather(mi.UInt32, photons.colour, edge))
    u = dr.dot(met - x, dr.normalize(dr.cross(A.d, beam.d)))
    start = dr.gather(mi.UInt32, photons.parent, edge)
    first = dr.gather(mi.Float, photons.density, edge) == 0
    far = first & lights.far(dr.gather(mi.UInt32, starts.index, start, first))
    target = shift.past(dr.gather(mi.Point3f, photons.o, edge), beam.d, y, B.d, -u, far)
    way = redirected(scene, lights, starts, photons, edge, photon, met, target, True, fog)
    reach = dr.dot(target - way.ray.o, way.ray.d)
    other = beam_past(B, target, way.ray.d, reach, radius)
    J = (other.sin / beam.sin) * shift.jacobian_in_medium(way.base_length2, way.length2)
    r = way.ratio * J
    good = other.passes & (reach > 0) & (dr.max(way.Φ) > 0) & (r > 0) & dr.isfinite(r)
    # Past A it would be gathered as it is, not as a copy: the shift back would be another.
    good &= ~beam_past(A, target, way.ray.d, reach, radius).passes
    T, T_c, surface, _, there = let_through(scene, fog, way, reach, good)
    good &= ~surface.is_valid() & (there == medium)
    here = dr.zeros(mi.MediumInteraction3f, dr.width(reach))
    here.p, here.wavelengths, here.medium = target, way.ray.wavelengths, there
    σs, _, _ = there.get_scattering_coefficients(here, good)
    Φ = dr.select(good, way.Φ * σs * (J * T) / other.sin, 0)
    return Photon(target, mi.Normal3f(0), way.ray.d, Φ, medium, photon.channel), other, r * T_c, good


class GBEAMS(GBRE):
    """Gradients of photon beams in homogeneous media, and of photons on surfaces.

    Plugin ``gbeams``. Parameters are those of ``gpm``; bias and what is not handled are those of ``beams``.
    """

    name = "gbeams"
    edges, map_bytes = True, BEAM_BYTES + PARTS * PART_BYTES
    pairs, camera_bytes = PAIRS, PATHS_BYTES + PAIRS * PAIR_BYTES

    def gathered(self, passes: Passes, starts: LightRay, photons, number: int, paths: int) -> Iterator:
        radius = self.radius * passes.width
        on_surfaces: Near | None = Near(starts, photons, radius * shrunk(number), paths)
        radius *= shrunk(number, 1)
        for parts in parts_of(passes, self.fog, photons, radius, PARTS * paths):
            beams = AlongBeams(parts, radius, paths, self.max_depth)
            near = NearBeams(starts, photons, beams, beams.grid, dr.opaque(mi.Float, radius**2))
            yield Both(on_surfaces, near)
            on_surfaces = None


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gbeams``, with the parameters of the scene's own ``volpath`` or ``path``."""
    return like_path(scene, "gbeams", **options).prepare(scene)


mi.register_integrator("gbeams", lambda props: GBEAMS(props))
