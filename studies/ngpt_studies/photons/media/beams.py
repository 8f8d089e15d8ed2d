r"""Photon beams: in media, light is gathered from the edges of light paths and not from their vertices.

    d, Φ        direction of a beam, its power where it begins, times σs
    s, t        distances along the beam and along the camera ray to where both are nearest to each other
    θ           the angle between them
    c           the colour by which the light path samples its distances
    L           Σ T(s) / T_c(s) T(t) f(d) Φ / (2 r N sin θ) of all beams that are nearer than r there,
                f: the phase function, N: light paths of the pass

A light path leaves one photon where it scatters, and light all along its edges. So a ray meets many more beams than
photons, and the blur is one-dimensional. A beam ends with its edge. An edge reaches so far with the probability T_c(s).

In media whose density varies a beam goes by the null collisions of its edge up to where the light path scatters: it
comes so far with the probability T. In such media Φ is without σs, which is taken where the ray is nearest.

Beams are cut into parts, which lie in the ``Grid`` by their middles. Only one part contains the point where a beam and
a ray are nearest to each other.

[Jarosz et al. 2011, "A Comprehensive Theory of Volumetric Radiance Estimation Using Photon Points and Beams", the beam
x beam estimate with a one-dimensional blur; the radius: radius.py]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, get_type_hints

import drjit as dr
import mitsuba as mi

from data_gen.paths import collisions, media
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import World
from data_gen.samplers.photons.bre import BALL, BRE, Along, scattering_along, seen_along
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.trace import VERTICES_PER_PATH
from data_gen.samplers.photons.map.vertices import put
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.photons.ppm import Gathering
from ngpt_studies.photons.map.trace import EDGE_BYTES
from ngpt_studies.photons.map.whole import GRID_BYTES, MEDIA_MAP_BYTES, Traced, whole_maps

# Length of a part, in radii. Shorter parts are more to enter. Longer parts are more often near to no ray.
PART = 6
# Parts that are in memory together, for each light path; and the bytes of one, including the grid's.
PARTS = 32
PART_BYTES = (18 + 9) * 4
# Bytes of a light path with its edges
BEAM_BYTES = MEDIA_MAP_BYTES + VERTICES_PER_PATH * EDGE_BYTES


@cache
def parts_class(variant: str) -> type:
    """The class of beams' parts; Mitsuba's types belong to a variant."""

    @dataclass
    class Parts:
        """Parts of beams as a structure of arrays: 18 words a part."""

        p: mi.Point3f  # the middle
        d: mi.Vector3f
        half: mi.Float  # of its length; 0 of an empty place
        before: mi.Float  # from the middle back to where the beam enters the medium
        after: mi.Float  # from there on to where it ends, or leaves the medium
        Φ: mi.Spectrum  # at the middle, times σs but in scenes with grids
        σ: mi.Spectrum  # by which it falls along the beam
        medium: mi.MediumPtr
        depth: mi.UInt32  # edges from the light, including the beam's edge
        edge: mi.UInt32  # its place in the map

        def __len__(self) -> int:
            return dr.width(self.half)

    return Parts


@dr.syntax
def cut(world: World, edges, rate: mi.Float, first: mi.UInt32, window: tuple, parts: Any) -> mi.UInt32:
    """How many parts the ``edges`` of light paths have, ``rate`` of them in a unit of length.

    The parts of an edge are numbered from ``first`` on. The parts in the ``window`` (low, size) are entered into the
    arrays ``parts``, unless these are None.
    """
    scene, fog, (low, size) = world.scene, world.fog, window
    ray, medium = mi.Ray3f(edges.o, edges.e), mi.MediumPtr(edges.begins)  # a piece, and what it goes through
    Φ = mi.Spectrum(edges.power)  # where the piece begins
    number = mi.UInt32(first)  # of the next part
    alive, edge = edges.bounce > 0, dr.arange(mi.UInt32, len(edges))
    scatters, grids = (edges.t > 0) & (dr.squared_norm(edges.n) == 0), fog.media.grids
    nulls, ahead = mi.UInt32(0), mi.Float(0)  # null collisions so far, and the optical depth to the next
    if dr.hint(grids, mode="scalar"):
        ahead = collisions.step(edges.key, nulls)
    left = dr.select(scatters, dr.dot(edges.p - edges.o, edges.e), dr.inf)  # of the edge, if it ends in a medium
    while dr.hint(alive, label="beams"):
        # -------------- The piece: up to where, and how it falls --------------
        hit = scene.ray_intersect_preliminary(media.shortened(ray, left), active=alive)
        found, inside = alive & hit.is_valid(), alive & (medium != None)  # noqa: E711 - an array of pointers
        here = dr.zeros(mi.MediumInteraction3f, dr.width(edges.o))
        here.p, here.wavelengths, here.medium = ray.o, ray.wavelengths, medium
        σs, _, σ = medium.get_scattering_coefficients(here, inside)
        σs, σ = dr.select(inside, σs, 0), dr.select(inside, σ, 0)
        # Where the path has gone so far, with that density
        falls, length = σ - media.pick(σ, edges.colour), dr.select(found, hit.t, left)
        skips, null = mi.Bool(False), mi.Spectrum(1)
        if dr.hint(grids, mode="scalar"):
            stop = collisions.next_stop(ray, length, medium, edges.colour, ahead, inside)
            skips = stop.collides & (nulls < edges.nulls)
            # Between null collisions a beam keeps its colours.
            σs, falls = dr.select(inside, mi.Spectrum(1), 0), dr.select(stop.grid, 0, falls)
            length, null = dr.select(skips, stop.t, length), stop.null
            found &= ~skips

        # ------------------------------ Its parts ------------------------------
        parts_here = mi.UInt32(dr.minimum(dr.ceil(length * rate), 1 << 16))
        lit = inside & (dr.max(Φ * σs) > 0) & (length > 0) & dr.isfinite(length)
        parts_here = dr.select(lit, dr.maximum(parts_here, 1), 0)
        if dr.hint(parts is not None, mode="scalar"):
            k, half = mi.UInt32(0), 0.5 * length / parts_here
            while dr.hint(k < parts_here, label="parts of beams"):
                place = number + k - low
                s = (2 * k + 1) * half
                part = type(parts)(
                    p=ray(s),
                    d=ray.d,
                    half=half,
                    before=s,
                    after=length - s,
                    Φ=Φ * σs * dr.exp(-falls * s),
                    σ=falls,
                    medium=medium,
                    depth=edges.bounce,
                    edge=edge,
                )
                put(parts, part, place, place < size)
                k += 1
        number += parts_here

        # ------------ Behind a boundary that bends nothing, or a null collision ------------
        Φ = dr.select(found, Φ * dr.exp(-media.depth(falls, hit.t)), dr.select(skips, Φ * null, 0))
        left -= length
        alive = (skips | found & fog.media.passes(hit.shape)) & (dr.max(Φ) > 0)
        if dr.hint(grids, mode="scalar"):
            nulls = dr.select(skips, nulls + 1, nulls)
            ahead = dr.select(skips, collisions.step(edges.key, nulls), ahead - stop.passed)
            ray = dr.select(skips, mi.Ray3f(ray(length), ray.d, ray.time, ray.wavelengths), ray)
        if alive & found:
            ray, medium = media.beyond(ray, hit, medium)
    return number - first


@dataclass(init=False)
class AlongBeams:
    """Parts of the beams of a map, gathered beside rays; for paths of at most ``max_depth`` edges."""

    parts: Any
    grid: Grid
    radius: mi.Float
    reach: mi.Float
    K: mi.Float
    max_depth: mi.UInt32
    grids: bool

    def __init__(self, parts, traced: Traced, max_depth: int, grids: bool = False):
        self.parts, self.grids, radius = parts, grids, traced.radius(1)
        # The middle of a part that is near to a ray is no further away.
        reach = radius * (1 + PART / 2)
        self.grid = Grid(parts.p, parts.half > 0, BALL * reach)
        self.radius, self.reach = dr.opaque(mi.Float, radius), dr.opaque(mi.Float, reach)
        self.K = dr.opaque(mi.Float, 1 / (2 * radius * traced.paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def each(self, ray, length, active, visit, state: tuple) -> tuple:
        """``state`` after visits to the beams beside a piece of a ray, and to parts that are not.

        ``visit`` is called with (state, place in the list of the grid, whether it is beside), and changes nothing where
        it is not.
        """

        def beside(state, i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            d, half = dr.gather(mi.Vector3f, self.parts.d, j, near), dr.gather(mi.Float, self.parts.half, j, near)
            s, t, aside, _ = nearest(ray.o, ray.d, dr.gather(mi.Point3f, self.grid.p, i, near), d)
            return visit(state, i, near & (aside < self.radius) & (s >= -half) & (s < half) & (t > 0) & (t < length))

        # Middles may lie beyond the ends of the piece.
        longer = mi.Ray3f(ray)
        longer.o = ray.o - ray.d * self.reach
        return self.grid.along(longer, length + 2 * self.reach, dr.square(self.reach), active, beside, state)

    def light(self, ray, length, medium: mi.MediumPtr, σ: mi.Spectrum, depth: mi.UInt32, active) -> mi.Spectrum:
        """Σ of the beams beside a piece of a ray through one ``medium``, of paths that are not too long.

        ``depth`` is the number of the segment; T(t) is of the piece only.
        """
        parts, longest = self.parts, self.max_depth - depth
        phase, seen = medium.phase_function(), seen_along(ray, medium)
        scattering = scattering_along(ray, medium) if self.grids else None

        def add(sums, i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            near = near & (dr.gather(mi.MediumPtr, parts.medium, j, near) == medium)
            near &= dr.gather(mi.UInt32, parts.depth, j, near) <= longest
            d = dr.gather(mi.Vector3f, parts.d, j, near)
            s, t, _, sin = nearest(ray.o, ray.d, dr.gather(mi.Point3f, self.grid.p, i, near), d)
            Φ, falls = dr.gather(mi.Spectrum, parts.Φ, j, near), dr.gather(mi.Spectrum, parts.σ, j, near)
            if dr.hint(self.grids, mode="scalar"):
                Φ *= scattering(t, near)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(), seen, -d, near)
            return (sums[0] + dr.select(near, f * Φ * dr.exp(-σ * t - falls * s) / sin, 0),)

        zero = dr.zeros(mi.Spectrum, dr.width(length))
        return self.K * self.each(ray, length, active, add, (zero,))[0]


def nearest(o, d, p, e) -> tuple:
    """Where two lines are nearest: through ``o`` along ``d``, and through ``p`` along ``e``, unit vectors.

    Returns the distances from p, and from o, how far the lines are apart, and the sine of their angle. Where they are
    parallel no value is finite.
    """
    n, to, cos = dr.cross(d, e), p - o, dr.dot(d, e)
    sin2 = dr.squared_norm(n)
    along, back = dr.dot(to, d), dr.dot(to, e)
    sin = dr.sqrt(sin2)
    return (cos * along - back) / sin2, (along - cos * back) / sin2, dr.abs(dr.dot(to, n)) / sin, sin


class BEAMS(BRE):
    """Progressive photon beams in media, and photons on surfaces; no gradients.

    Plugin ``beams``. Parameters and what is not handled: as for ``vpm``. Biased, and consistent; in media the
    ``radius`` shrinks faster.
    """

    map_bytes, grid_bytes = BEAM_BYTES + PARTS * PART_BYTES, GRID_BYTES

    def maps(self, passes: Passes, camera: CameraSamples) -> Iterator[Traced]:
        return whole_maps(self, passes, camera, edges=True)

    def near(self, passes: Passes, traced: Traced) -> Iterator[Along]:
        max_depth, fog = self.limits.max_depth, passes.world.fog
        on_surfaces: Gathering | None = Gathering(passes.world, traced, max_depth)
        for parts in parts_of(passes, traced, PARTS * traced.paths):
            yield Along(on_surfaces, AlongBeams(parts, traced, max_depth, fog.media.grids))
            on_surfaces = None


def parts_of(passes: Passes, traced: Traced, most: int) -> Iterator[Any]:
    """The beams of a map in parts, at most this number at a time; empty ones if there are none."""
    kind, photons, frozen = parts_class(mi.variant()), traced.photons, passes.frozen
    rate = dr.opaque(mi.Float, 1 / (PART * traced.radius(1)))
    count = frozen(counted, passes.world, photons, rate)
    first = dr.prefix_sum(count)
    dr.eval(count, first)
    total = int(dr.sum(count)[0])
    for low in range(0, max(total, 1), most):
        size = max(min(most, total - low), 1)
        parts = kind(*(dr.zeros(t, size) for t in get_type_hints(kind).values()))
        dr.make_opaque(parts)
        window = dr.opaque(mi.UInt32, low), dr.opaque(mi.UInt32, size)
        parts = frozen(entered, passes.world, photons, rate, first, window, parts)
        dr.eval(parts)
        yield parts


def counted(world: World, photons, rate) -> mi.UInt32:
    none = mi.UInt32(0), mi.UInt32(0)
    return cut(world, photons, rate, dr.zeros(mi.UInt32, len(photons)), none, None)


def entered(world: World, photons, rate, first: mi.UInt32, window: tuple, parts):
    cut(world, photons, rate, first, window, parts)
    return parts
