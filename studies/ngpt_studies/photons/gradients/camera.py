"""Camera paths of a pixel and its neighbours, side by side from level to level: for the gradients of photons.

A camera path goes on as in ``ppm``: by mirrors, glass, sharp gloss and holes. The paths of the neighbouring pixels
replay the random numbers of the base path. So a path and its copy are the same numbers in two pixels, whatever they
meet: J = 1 and r = 1, as long as both go on.

``CameraPaths`` are those on surfaces, where a level is a vertex. In media a level is a piece of a ray through one of
them (``camera_in_media``), or a segment that ends where light scatters (``camera_segments``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import World
from data_gen.paths.mis import gradient_weight
from data_gen.paths.vertex import SMOOTH, Materials, event_kind
from data_gen.paths.walk import Sky, brightest, roulette
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.photons.passes import Start


@dataclass
class Path:
    """A camera path at some depth: what its last ``ray`` has hit, if it is ``alive``. Others have ended before."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f | None  # None before it is traced
    β: mi.Spectrum
    alive: mi.Bool
    sky: Sky

    def vertex(self) -> mi.SurfaceInteraction3f:
        return self.hit.compute_surface_interaction(self.ray, active=self.alive)

    def emission(self, scene) -> mi.Spectrum:
        """β Le of what the path has met."""
        si = self.vertex()
        met = self.alive & self.sky.meets(si)
        return dr.select(met, self.β * si.emitter(scene).eval(si, met), 0)


@dataclass
class Level:
    """Base paths that have come to some level, and their offset paths; with what is needed to go on."""

    paths: list  # the base path, and the four offset paths
    lanes: mi.UInt32  # the camera samples that they belong to
    depth: mi.UInt32  # edges from the camera
    η: mi.Float  # the product of the base path's relative indices of refraction
    numbers: mi.PCG32  # random numbers for the levels to come
    channel: mi.UInt32 | None = None  # the colour by which distances are sampled, where they are
    # At the first level: what each path has seen through grids, if there are any
    behind: list = field(default_factory=list)


class CameraPaths:
    """How camera paths begin and go on, of an ``integrator`` that renders some ``world``."""

    def __init__(self, integrator: Any, world: World):
        self.integrator, self.world, self.limits = integrator, world, integrator.limits

    def levels(self, rays: list, random: mi.Sampler, frozen: Callable) -> Iterator[Level]:
        """Level after level of the paths that begin with ``rays``, each evaluated.

        Each ray is given as (ray, importance, whether it is on the film); the first is the base path's. ``frozen``
        calls the functions that make kernels.
        """
        n, stream = dr.width(rays[0][0].o), type(random)
        start = Level([], dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, 1, n), dr.opaque(mi.Float, 1, n), random.state)
        dr.eval(start)
        level, number = frozen(self.begun, start, stream(start.numbers), rays), 1
        while True:
            dr.eval(level)
            yield level
            if self.is_last(number):
                return
            level = frozen(self.onward, level, stream(level.numbers))
            dr.eval(level)
            go_on = dr.compress(level.paths[0].alive)
            if not dr.width(go_on):
                return
            level, number = frozen(self.further, level, stream(level.numbers), go_on), number + 1

    # ------------------- What depends on where paths are gathered -------------------

    def is_last(self, number: int) -> bool:
        """Whether no path goes on behind the level of that number, from 1."""
        return number >= self.limits.max_depth

    def begun(self, start: Level, random, rays: list) -> Level:
        paths = [self.first(*ray) for ray in rays]
        for path in paths:
            path.hit = self.integrator.first_hit(self.world.scene, path.ray)
        return replace(start, paths=paths)

    def onward(self, level: Level, random) -> Level:
        """The paths after their next event, before their rays are traced."""
        random = random.clone()
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        steps = [scattered(path, self.world.materials, u_lobe, u_direction) for path in level.paths]
        paths = [path for path, _ in steps]
        η = dr.select(paths[0].alive, level.η * steps[0][1], level.η)
        survive(paths, u_survival, level.depth >= self.limits.rr_depth, η)
        return replace(level, paths=paths, depth=level.depth + 1, η=η, numbers=random.state, behind=[])

    def further(self, level: Level, random, lanes: mi.UInt32) -> Level:
        """The paths of these ``lanes``, up to what their rays hit."""
        paths = [at_lanes(path, lanes) for path in level.paths]
        for path in paths:
            path.hit = self.world.scene.ray_intersect_preliminary(path.ray, active=path.alive)
        return self.of_lanes(level, paths, random.at(lanes), lanes)

    def direct(self, level: Level, start: Start, frozen: Callable) -> mi.Spectrum:
        """Le that is seen directly, of the first level."""
        if self.limits.max_depth < 1:
            return mi.Spectrum(0)
        return frozen(Path.emission, level.paths[0], self.world.scene)

    def emitted(self, level: Level) -> list:
        """Emission that base paths meet at a later level, and its four Δ."""
        return emission_of(self.world.scene, level.paths)

    def at_surfaces(self, level: Level, frozen: Callable) -> list[Path]:
        """The paths that end at surfaces at this level, evaluated; others are not alive."""
        return level.paths

    # ------------------------------ What they all share -----------------------------

    def first(self, ray, importance, inside) -> Path:
        ray, n = mi.Ray3f(ray), dr.width(ray)
        β = mi.Spectrum(importance) + dr.zeros(mi.Spectrum, n)
        # As wide as the ray, and not a constant
        alive = inside & (mi.UInt32(0) == dr.zeros(mi.UInt32, n))
        return Path(ray, None, β, alive, Sky.from_camera(self.limits.hide_emitters, n))

    def of_lanes(self, level: Level, paths: list, random, lanes: mi.UInt32) -> Level:
        """The ``level`` with these ``paths`` and ``random`` numbers, of some of its ``lanes``."""
        channel = None if level.channel is None else taken(level.channel, lanes)
        of_samples, depth, η = (taken(value, lanes) for value in (level.lanes, level.depth, level.η))
        return Level(paths, of_samples, depth, η, random.state, channel)


def scattered(path: Path, materials: Materials, u_lobe, u_direction) -> tuple[Path, mi.Float]:
    """A path behind its next event, its hit still unknown; and the relative index of refraction."""
    si = path.vertex()
    bsdf = si.bsdf()
    here = path.alive & si.is_valid()
    sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, here)
    kind = event_kind(sample.sampled_type)
    β = path.β * f_p
    # Photons are gathered where the material scatters widely, and the path ends.
    alive = here & (sample.pdf > 0) & ((kind != SMOOTH) | ~materials.connectable(bsdf)) & (dr.max(β) > 0)
    ray = si.spawn_ray(si.to_world(sample.wo))
    return Path(ray, path.hit, β, alive, path.sky.behind(kind, alive)), sample.eta


def survive(paths: list, u: mi.Float, plays: mi.Bool, η: mi.Float) -> None:
    """Russian roulette in the lanes where ``plays`` is true: all five paths survive together."""
    survival = roulette(brightest(paths), plays, η)
    paths[0].alive &= u < survival
    for path in paths:
        path.β /= survival


def taken(value: Any, lanes: mi.UInt32) -> Any:
    return dr.gather(type(value), value, lanes)


def at_lanes(path: Path, lanes: mi.UInt32) -> Path:
    """The part of a path that belongs to these ``lanes``; the hit stays."""
    old = path.ray
    time = taken(old.time, lanes) if dr.width(old.time) > 1 else old.time
    wavelengths = taken(old.wavelengths, lanes) if dr.width(old.wavelengths) > 1 else old.wavelengths
    ray = mi.Ray3f(taken(old.o, lanes), taken(old.d, lanes), time, wavelengths)
    ray.maxt = taken(old.maxt, lanes) if dr.width(old.maxt) > 1 else old.maxt
    sky = Sky(taken(path.sky.seen, lanes))
    return replace(path, ray=ray, β=taken(path.β, lanes), alive=taken(path.alive, lanes), sky=sky)


def emission_of(scene, paths: list[Path]) -> list:
    """Emission that the base path meets, and its four Δ."""
    C = paths[0].emission(scene)
    return [C, *(gradient_weight(mi.Float(1), path.alive) * (path.emission(scene) - C) for path in paths[1:])]
