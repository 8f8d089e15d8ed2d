r"""The gradient-domain path tracer whose pixels share their paths in tiles.

Each pixel of a tile traces a path. The path's *suffix*, its part from the second vertex on, is also connected to the
first vertices of the other pixels of the tile. So N pixels have N suffixes each, for the value and for each difference:

    x_i               first vertex of the path of pixel i of a tile
    s_j               second vertex of the path of pixel j, where its suffix begins
    J_ij              dω_i / dω_j of the directions from x_i and from x_j to s_j; 1 if s_j is infinitely far away
    V                 1 if x_i sees s_j, else 0
    q_i(s_j)          p J_ij V, the density with which pixel i samples s_j, in the solid angle at x_j
    C_i(s_j)          f J_ij V L, the contribution of the path x_i, s_j, ... to pixel i, in the same solid angle
    D(s_j)            Σ_k q_k(s_j), over the pixels k of the tile: the denominator of the balance heuristic
    I_i               Σ_j C_i(s_j) / D(s_j), the estimate of pixel i
    dx, dy            I_k - I_i within a tile, where both pixels have the same suffixes and denominators

There are two pairs of q and C. A path that ends at s_j, or at an emitter sampled from s_j, needs only s_j (C1, q1, D1).
A path that goes on also needs the direction that was sampled at s_j. Its density depends on the direction from which
the path arrives (C2, q2, D2). Each path keeps its own MIS weights m: C is the contribution f m of one technique. For
emitter sampling at x_i, pixel i uses the random numbers of all pixels of the tile. All have the same density, so D is
the number of pixels.

A difference across the border of two tiles uses only the suffixes of its two pixels, as in ``gpt``. The grid of tiles
moves from sample to sample, so that the two pixels are in one tile in other samples. Both estimates are unbiased for
any position of the grid.

A suffix is shared if x_i, x_j and s_j are connectable and the event at x_j is smooth. Otherwise only its own pixel uses
it, for the primal and for differences. The rule treats the pixels of a pair alike, so they agree on it.

[Bauszat, Petitjean, Eisemann 2017, "Gradient-domain path reusing"; Bekaert, Sbert, Halton 2002, "Accelerating path
tracing by reusing paths"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 6.1]
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.lights import LightSample, emission, sample_light
from data_gen.paths.mis import mis_weight
from data_gen.paths.shift import reconnection_jacobian
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import Materials, evaluate, seen_from
from data_gen.samplers.common import GradientIntegrator
from data_gen.samplers.teaching.gpt_simple import base_step, reflected, trace, walk

# Bytes of a lane for its suffix, its camera sample and its sums; bytes of one connection
_LANE_BYTES, _CONNECTION_BYTES = 272, 32


class GPTTiles(GradientIntegrator):
    """Gradient-domain path tracing with path reuse in tiles, for surfaces.

    Plugin ``gpt_tiles``. Parameters: ``max_depth`` and ``rr_depth`` as for Mitsuba's ``path`` (roulette begins at the
    third vertex at the earliest), ``tile`` and ``roughness_threshold``. The noise within a tile is correlated, since
    its pixels share paths. Variances do not show that: they are those of each pixel over its samples. Not handled:
    media, which are not seen; hidden emitters, polarised and spectral variants, for which rendering raises NgptError.
    """

    def sample(self, scene, sampler, ray, medium=None, active=True):
        L, Le, _ = trace(scene, self.limits, sampler, ray, mi.Spectrum(1), [])
        return L + Le, mi.Bool(True), []

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        return Tiles(self, scene)


class Tiles:
    """Takes the samples of a pass; ``lane_bytes`` grows with the tile."""

    def __init__(self, integrator: GPTTiles, scene: mi.Scene):
        self.integrator, self.scene, self.side = integrator, scene, integrator.options["tile"]
        self.materials = Materials(scene, integrator.options["roughness_threshold"])
        self.lane_bytes = _LANE_BYTES + _CONNECTION_BYTES * self.side**2

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        keep_in_step(camera)
        Le, paths = self.trace(camera)
        grid = Grid(camera, self.side)
        I = self.shared(camera, paths, grid.others())  # noqa: E741 - the symbol of the equations
        film.put("primal", I + rgb(Le))
        film.put("direct", rgb(Le))
        for axis, name in enumerate(("dx+", "dy+")):
            across = grid.across(axis)
            beyond = self.shared(camera, paths, [across])
            # Both pixels of a pair have the same difference, so only one of them puts it.
            next_one = grid.neighbour(*SHIFTS[name])
            crosses = across.active & (across.lane == next_one.lane)
            here, there = dr.select(crosses, beyond, I), (beyond, I)
            beyond, inner = (dr.gather(mi.Color3f, image, next_one.lane, next_one.active) for image in there)
            Δ = dr.select(crosses, beyond, inner) - here
            dr.eval(Δ, next_one.active)
            film.put(name, Δ, next_one.active)
        del paths
        film.put_all(features(self.scene, camera.sensor, camera.random.clone(), camera.rays()[0]))

    def shared(self, camera: CameraSamples, paths: Paths, links: list[Link]) -> mi.Color3f:
        """The estimate I of each pixel, from its own path and the paths of the pixels that ``links`` lead to."""
        members, direct, count = [(None, paths.own)], paths.direct, dr.select(paths.lives, mi.Float(1), 0)
        for link in links:
            connection, light = self.connect(camera, paths, link)
            direct = direct + light
            dr.eval(connection, direct)
            members.append((link, connection))
            count += dr.select(paths.both(link), mi.Float(1), 0)
        return balanced(members) + dr.select(count > 0, direct / count, 0)

    def trace(self, camera: CameraSamples) -> tuple[mi.Spectrum, Paths]:
        """The emission that is seen directly, and the path of each pixel."""
        scene, materials, random = self.scene, self.materials, camera.random.clone()
        limit = self.integrator.limits.max_depth
        ray, importance, _ = camera.rays()
        ray = mi.Ray3f(ray)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        x = hit.compute_surface_interaction(ray)
        Le = importance * x.emitter(scene).eval(x, limit > 0)
        Le = self.integrator.emission_in_pixel(scene, camera, Le)

        lives = x.is_valid() & (limit > 1)
        first = base_step(scene, random, x, importance, lives)
        s = first.x1
        second = base_step(scene, random, s, mi.Spectrum(1), s.is_valid() & (limit > 2))
        R = walk(scene, self.integrator.limits, random, second.x1)

        # Not divided by densities, like the connections of other pixels: the own path is one with J = V = 1.
        C = first.β1 * first.p
        C1 = C * (first.L_bsdf + second.L_light)
        C2 = C * second.β1 * second.p * (second.L_bsdf + R)
        q1 = dr.select(first.goes_on, first.p, 0)
        q2 = dr.select(second.goes_on, q1 * second.p, 0)
        own, direct = Connection(rgb(C1), rgb(C2), q1, q2), rgb(importance * first.L_light)

        # ------------------------ The suffix -------------------------
        shared = first.goes_on & first.smooth & materials.connectable(x.bsdf())
        shared &= ~s.is_valid() | materials.connectable(s.bsdf())
        to_s, light = x.spawn_ray(x.to_world(first.wo)), second.light
        suffix = Suffix(
            shared=shared,
            u_light=first.u_light,
            o=to_s.o,
            d=to_s.d,
            s=first.hit,
            light_d=light.d,
            light_p=light.p,
            light_delta=mi.Bool(light.delta),
            light_weight=light.weight,
            goes_on=second.goes_on & second.smooth,
            wo=second.wo,
            Le=second.Le,
            p_light=second.p_light,
            R=R,
        )
        # All in one kernel
        dr.eval(Le, hit, lives, own, direct, *vars(suffix).values())
        return Le, Paths(hit, lives, suffix, own, direct)

    def connect(self, camera: CameraSamples, paths: Paths, link: Link) -> tuple[Connection, mi.Color3f]:
        """Connects the first vertex of each pixel to the suffix of the pixel that ``link`` leads to.

        Also returns the light that emitter sampling finds at the first vertex with that pixel's random numbers.
        """
        scene, materials = self.scene, self.materials
        # --------------- The vertices, from stored intersections ---------------
        ray, importance, _ = camera.rays()
        ray = mi.Ray3f(ray)
        y = paths.hit.compute_surface_interaction(ray)
        there = paths.both(link)
        suffix = paths.suffix.at(link.lane, there)
        s = suffix.s.compute_surface_interaction(mi.Ray3f(suffix.o, suffix.d, ray.time, ray.wavelengths))

        # --------------- Emitter sampling at y: the same numbers ---------------
        direct = reflected(sample_light(scene, y, suffix.u_light, there), y)

        # ----------------------- Reconnection, from y to s ---------------------
        reaches = s.is_valid()
        direction = dr.select(reaches, dr.normalize(s.p - y.p), suffix.d)
        J = dr.select(reaches, reconnection_jacobian(suffix.o, y.p, s.p, s.n), 1)
        f, p = evaluate(y.bsdf(), y, y.to_local(direction))
        good = there & suffix.shared & materials.connectable(y.bsdf()) & (p > 0) & dr.isfinite(J)
        shadow = dr.select(reaches, y.spawn_ray_to(s.p), y.spawn_ray(direction))
        good &= ~scene.ray_test(shadow, good)
        q1 = dr.select(good, p * J, 0)
        C = dr.select(good, importance * f * J, 0)
        s = seen_from(s, direction)
        Le, p_light = emission(scene, s, y, good, good)
        light = LightSample(suffix.light_d, suffix.light_p, suffix.light_delta, suffix.light_weight, s.p)
        C1 = C * (Le * mis_weight(p, p_light) + reflected(light, s))

        # ------------- On from s: the same direction, another density ----------
        f, p = evaluate(s.bsdf(), s, suffix.wo)
        goes_on = good & suffix.goes_on & (p > 0)
        q2 = dr.select(goes_on, q1 * p, 0)
        C2 = dr.select(goes_on, C * f * (suffix.Le * mis_weight(p, suffix.p_light) + suffix.R), 0)
        return Connection(rgb(C1), rgb(C2), q1, q2), rgb(dr.select(there, importance * direct, 0))


@dataclass
class Suffix:
    """A path from its second vertex on, with the data to connect another first vertex to it."""

    shared: mi.Bool  # whether other pixels may use it
    u_light: mi.Point2f  # the random numbers of emitter sampling at the first vertex
    o: mi.Point3f  # the ray from the first vertex to s
    d: mi.Vector3f
    s: mi.PreliminaryIntersection3f
    light_d: mi.Vector3f  # the emitter sampled at s: see LightSample
    light_p: mi.Float
    light_delta: mi.Bool
    light_weight: mi.Spectrum
    goes_on: mi.Bool  # whether other pixels may go on along ``wo``
    wo: mi.Vector3f
    Le: mi.Spectrum  # emission at the third vertex
    p_light: mi.Float  # density with which emitter sampling at s would have found this emission
    R: mi.Spectrum  # all other radiance from the third vertex

    def at(self, lanes: mi.UInt32, active: mi.Bool) -> Suffix:
        def taken(value: Any) -> Any:
            return dr.gather(type(value), value, lanes, active) if dr.width(value) > 1 else value

        return Suffix(**{field.name: taken(getattr(self, field.name)) for field in fields(self)})


@dataclass
class Connection:
    """Contributions and densities of one suffix for one pixel, in the lane of that pixel."""

    C1: mi.Color3f
    C2: mi.Color3f
    q1: mi.Float
    q2: mi.Float


@dataclass
class Paths:
    hit: mi.PreliminaryIntersection3f  # the first vertex
    lives: mi.Bool  # whether there is a first vertex
    suffix: Suffix
    own: Connection  # the connection of the pixel to its own suffix
    direct: mi.Color3f  # the light that emitter sampling found at the first vertex

    def both(self, link: Link) -> mi.Bool:
        """Whether both the pixel and the one that ``link`` leads to have a first vertex."""
        return self.lives & dr.gather(mi.Bool, self.lives, link.lane, link.active)


@dataclass
class Link:
    """For each lane, the ``lane`` of another pixel with the same sample; if ``active``, that lane's link leads back."""

    lane: mi.UInt32
    active: mi.Bool


class Grid:
    """The tiles of pixels, for each sample."""

    def __init__(self, camera: CameraSamples, side: int):
        self.camera, self.side = camera, side
        self.lane = dr.arange(mi.UInt32, dr.width(camera.pixel))
        width, height = camera.size
        self.place = camera.pixel % dr.opaque(mi.UInt32, width), camera.pixel // dr.opaque(mi.UInt32, width)
        self.size = width, height
        # The distance between neighbours in a tile; tests change it.
        self.stride = SHIFTS["dx+"][0]
        offsets = camera.sample % side, camera.sample // side % side
        #: the place of a pixel in its tile
        self.slot = tuple((p // self.stride + o) % side for p, o in zip(self.place, offsets, strict=True))

    def others(self) -> list[Link]:
        """Links to all other pixels of the tile. An exclusive or pairs the places, so that links lead back."""
        # Opaque, so that all connections are the same kernel
        all_bits = [dr.opaque(mi.UInt32, bits) for bits in range(self.side)]
        pairs = [(x, y) for y in all_bits for x in all_bits][1:]
        return [
            self.neighbour(*((mi.Int32(slot ^ bits) - mi.Int32(slot)) * self.stride for slot, bits in pair))
            for pair in (zip(self.slot, bits, strict=True) for bits in pairs)
        ]

    def across(self, axis: int) -> Link:
        """The link from a pixel at the border of its tile to the neighbour along ``axis`` in the next tile."""
        slot = self.slot[axis]
        step = dr.select(slot == self.side - 1, mi.Int32(self.stride), 0)
        step = dr.select(slot == 0, -mi.Int32(self.stride), step)
        link = self.neighbour(*((step, 0) if axis == 0 else (0, step)))
        return Link(link.lane, link.active & (step != 0))

    def neighbour(self, x: mi.Int32 | int, y: mi.Int32 | int) -> Link:
        """The link to the pixel at the offset (x, y); not active where that is outside the image."""
        (width, height), (here_x, here_y) = self.size, self.place
        there_x, there_y = mi.Int32(here_x) + x, mi.Int32(here_y) + y
        width, height = (dr.opaque(mi.Int32, n) for n in (width, height))
        active = (there_x >= 0) & (there_x < width) & (there_y >= 0) & (there_y < height)
        block = dr.opaque(mi.Int32, self.camera.block)
        lane = mi.UInt32(dr.select(active, mi.Int32(self.lane) + block * (x + width * y), 0))
        return Link(lane, active)


def keep_in_step(camera: CameraSamples) -> None:
    """Gives the samples of all pixels the first pixel's place within the pixel, point on the lens and time.

    Otherwise most of the noise of a difference would come from the different places within the two pixels.
    """
    leader = dr.arange(mi.UInt32, dr.width(camera.pixel)) - camera.pixel * dr.opaque(mi.UInt32, camera.block)
    same = camera.at(leader)
    camera.position = mi.Point2f(camera.pixel % camera.size.x, camera.pixel // camera.size.x) + same.position
    camera.lens, camera.time = same.lens, same.time
    dr.eval(camera.position, camera.lens, camera.time)


def balanced(members: list[tuple[Link | None, Connection]]) -> mi.Color3f:
    """Σ_j C_i(s_j) / D(s_j) of each pixel i, by the balance heuristic over the ``members`` of its tile.

    A link leads to the pixel that made the suffix; the link of a pixel to itself is None.
    """

    def of(link: Link | None, values: mi.Float) -> mi.Float:
        return dr.gather(mi.Float, values, link.lane, link.active) if link else values

    # For the suffix of each lane: the densities with which the pixels of the tile would have sampled it, summed. Each
    # density is stored in the lane of its pixel.
    D1, D2 = mi.Float(0), mi.Float(0)
    for link, c in members:
        D1, D2 = D1 + of(link, c.q1), D2 + of(link, c.q2)
    dr.eval(D1, D2)
    I = mi.Color3f(0)  # noqa: E741
    for link, c in members:
        for C, q, D in ((c.C1, c.q1, D1), (c.C2, c.q2, D2)):
            I += dr.select(q > 0, C / of(link, D), 0)  # noqa: E741
    dr.eval(I)
    return I


def rgb(value: mi.Spectrum) -> mi.Color3f:
    return to_rgb(value, mi.Color0f())
