r"""The gradient-domain path tracer whose pixels share their paths in tiles.

Each pixel of a tile traces a path. Its *suffix*, all from the second vertex on, is connected to the first vertices of
the other pixels of the tile as well. So each of N pixels has N suffixes for its value, and N for each difference:

    x_i               first vertex of the path of pixel i of a tile
    s_j               second vertex of pixel j's path, where its suffix begins; what it emits and reflects
    J_ij              dω_i / dω_j of the directions from x_i and from x_j to s_j; 1 if that is infinitely far away
    q_i(s_j)          density with which pixel i makes s_j, p J_ij V: all are in the solid angle at x_j; V: x_i sees s_j
    C_i(s_j)          contribution of the path x_i, s_j, ... to pixel i, f J_ij V L, in that solid angle too
    D(s_j)            Σ_k q_k(s_j), over the pixels k of the tile: the balance heuristic
    I_i               Σ_j C_i(s_j) / D(s_j), the estimate of pixel i; m and a second pair q, C: see below
    dx, dy            I_k - I_i within a tile: the suffixes and the denominators are the same

What ends at s_j, or at a lamp that was sampled there, needs only s_j (C1, q1, D1). What goes on from there needs also
the direction that was sampled at s_j, whose density depends on where the path has come from (C2, q2, D2). Each path
keeps its own MIS weights m: C is the contribution f m of one technique. Emitters are sampled at x_i by the numbers of
all pixels of the tile, all with one density: D is the number of pixels.

A difference across the border of two tiles has only the suffixes of its two pixels, as in ``gpt``. The grid of tiles
moves by a pixel from sample to sample, so that each pair of pixels is in one tile in its turn. Both are unbiased,
wherever the grid is.

A suffix is shared where all three vertices are connectable and the event at x_j is smooth. Otherwise only its own pixel
uses it, in primal and differences alike: the pixels of a pair agree on that, since the rule names neither first.

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

# Bytes of a lane: its suffix, its camera sample and sums; and what is kept of one connection.
_LANE_BYTES, _CONNECTION_BYTES = 272, 32


class GPTTiles(GradientIntegrator):
    """Gradient-domain path tracing with path reuse in tiles, for surfaces.

    Plugin ``gpt_tiles``, with ``max_depth`` and ``rr_depth`` (from the third vertex on at the earliest) of Mitsuba's
    ``path``, ``tile`` and ``roughness_threshold``. The noise of pixels of a tile is correlated, for they share their
    paths; variances are of each pixel over its samples, and do not say so. Not handled: media (they are not seen),
    hidden emitters, polarised and spectral variants; for the last three rendering raises NgptError.
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
            # Either end of a pair would say the same: it is put once.
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
        """I of each pixel, from its own path and from the paths of the pixels that ``links`` lead to."""
        members, direct, count = [(None, paths.own)], paths.direct, dr.select(paths.lives, mi.Float(1), 0)
        for link in links:
            connection, light = self.connect(camera, paths, link)
            direct = direct + light
            dr.eval(connection, direct)
            members.append((link, connection))
            count += dr.select(paths.both(link), mi.Float(1), 0)
        return balanced(members) + dr.select(count > 0, direct / count, 0)

    def trace(self, camera: CameraSamples) -> tuple[mi.Spectrum, Paths]:
        """The layer ``direct``, and the path of each pixel: its first vertex, its suffix, and its contribution here."""
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

        # With the densities left in, as other pixels have it: a path of its own is a connection with J = V = 1.
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
        # One kernel for all of it
        dr.eval(Le, hit, lives, own, direct, *vars(suffix).values())
        return Le, Paths(hit, lives, suffix, own, direct)

    def connect(self, camera: CameraSamples, paths: Paths, link: Link) -> tuple[Connection, mi.Color3f]:
        """The first vertex of each pixel, connected to the suffix of the pixel that ``link`` leads to.

        Also what emitter sampling finds there with that pixel's numbers.
        """
        scene, materials = self.scene, self.materials
        # --------------- The vertices, from what is kept of them ---------------
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

        # ------------- On from s: the direction is the same, its density not ---
        f, p = evaluate(s.bsdf(), s, suffix.wo)
        goes_on = good & suffix.goes_on & (p > 0)
        q2 = dr.select(goes_on, q1 * p, 0)
        C2 = dr.select(goes_on, C * f * (suffix.Le * mis_weight(p, suffix.p_light) + suffix.R), 0)
        return Connection(rgb(C1), rgb(C2), q1, q2), rgb(dr.select(there, importance * direct, 0))


@dataclass
class Suffix:
    """A path from its second vertex on, with the data to connect another first vertex to it."""

    shared: mi.Bool  # whether others may
    u_light: mi.Point2f  # the numbers of emitter sampling at the first vertex
    o: mi.Point3f  # the ray from there to s
    d: mi.Vector3f
    s: mi.PreliminaryIntersection3f
    light_d: mi.Vector3f  # the emitter sampled at s: see LightSample
    light_p: mi.Float
    light_delta: mi.Bool
    light_weight: mi.Spectrum
    goes_on: mi.Bool  # whether others may go on along ``wo``
    wo: mi.Vector3f
    Le: mi.Spectrum  # emitted at the third vertex
    p_light: mi.Float  # density with which emitter sampling at s would have found that
    R: mi.Spectrum  # all other radiance that comes from there

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
    hit: mi.PreliminaryIntersection3f  # its first vertex
    lives: mi.Bool  # whether it has one
    suffix: Suffix
    own: Connection  # of the suffix to its own pixel
    direct: mi.Color3f  # what emitter sampling found at the first vertex

    def both(self, link: Link) -> mi.Bool:
        """Whether a pixel and the one that ``link`` leads to have a first vertex."""
        return self.lives & dr.gather(mi.Bool, self.lives, link.lane, link.active)


@dataclass
class Link:
    """A link to the same sample of another pixel, by lanes; where it is ``active``, its own link leads back."""

    lane: mi.UInt32
    active: mi.Bool


class Grid:
    """Which pixels are in a tile together, sample by sample."""

    def __init__(self, camera: CameraSamples, side: int):
        self.camera, self.side = camera, side
        self.lane = dr.arange(mi.UInt32, dr.width(camera.pixel))
        width, height = camera.size
        self.place = camera.pixel % dr.opaque(mi.UInt32, width), camera.pixel // dr.opaque(mi.UInt32, width)
        self.size = width, height
        # Tiles consist of pixels that far apart; tests move them.
        self.stride = SHIFTS["dx+"][0]
        offsets = camera.sample % side, camera.sample // side % side
        #: the place of a pixel in its tile
        self.slot = tuple((p // self.stride + o) % side for p, o in zip(self.place, offsets, strict=True))

    def others(self) -> list[Link]:
        """Links to all other pixels of the tile. Places are paired by an exclusive or, so that links lead back."""
        # Opaque: all connections are one kernel.
        all_bits = [dr.opaque(mi.UInt32, bits) for bits in range(self.side)]
        pairs = [(x, y) for y in all_bits for x in all_bits][1:]
        return [
            self.neighbour(*((mi.Int32(slot ^ bits) - mi.Int32(slot)) * self.stride for slot, bits in pair))
            for pair in (zip(self.slot, bits, strict=True) for bits in pairs)
        ]

    def across(self, axis: int) -> Link:
        """The link to the neighbour along ``axis`` that is in another tile, for pixels at such a border."""
        slot = self.slot[axis]
        step = dr.select(slot == self.side - 1, mi.Int32(self.stride), 0)
        step = dr.select(slot == 0, -mi.Int32(self.stride), step)
        link = self.neighbour(*((step, 0) if axis == 0 else (0, step)))
        return Link(link.lane, link.active & (step != 0))

    def neighbour(self, x: mi.Int32 | int, y: mi.Int32 | int) -> Link:
        """The link to the pixel at (x, y) from here; not active where that is outside the image."""
        (width, height), (here_x, here_y) = self.size, self.place
        there_x, there_y = mi.Int32(here_x) + x, mi.Int32(here_y) + y
        width, height = (dr.opaque(mi.Int32, n) for n in (width, height))
        active = (there_x >= 0) & (there_x < width) & (there_y >= 0) & (there_y < height)
        block = dr.opaque(mi.Int32, self.camera.block)
        lane = mi.UInt32(dr.select(active, mi.Int32(self.lane) + block * (x + width * y), 0))
        return Link(lane, active)


def keep_in_step(camera: CameraSamples) -> None:
    """Gives all pixels the place in the pixel, the point on the lens and the time of the first one's sample.

    Within a pixel things look different from place to place, which would be the most of the noise of a difference.
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

    # As the maker of a suffix: densities with which the others would have made it, each in the lane of the other.
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
