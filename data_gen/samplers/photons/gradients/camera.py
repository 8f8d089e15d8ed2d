"""Camera paths of a pixel and its neighbours, side by side from vertex to vertex: for the gradients of ``gpm``.

A camera path goes on as in ``ppm``: by mirrors, glass, sharp gloss and holes. The paths of the neighbouring pixels
replay the random numbers of the base path. So a path and its copy are the same numbers in two pixels, whatever they
meet: J = 1 and r = 1, as long as both go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.frozen import call
from data_gen.paths.vertex import NULL, SMOOTH, Materials, event_kind
from data_gen.samplers.bdpt.vertex import RADIANCE, context


@dataclass
class Path:
    """A camera path at some depth: what its last ``ray`` has hit, if it is ``alive``. Others have ended before."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    β: mi.Spectrum
    alive: mi.Bool
    sky_seen: mi.Bool  # an escape sees the environment

    def vertex(self) -> mi.SurfaceInteraction3f:
        return self.hit.compute_surface_interaction(self.ray, active=self.alive)

    def emission(self, scene) -> mi.Spectrum:
        """β Le of what the path has met."""
        si = self.vertex()
        met = self.alive & (si.is_valid() | self.sky_seen)
        return dr.select(met, self.β * si.emitter(scene).eval(si, met), 0)


@dataclass
class Level:
    """Base paths that have come to some ``depth``, of the camera samples ``lanes``; and their offset paths."""

    first: bool
    lanes: mi.UInt32
    depth: mi.UInt32
    base: Path
    offsets: list[Path]


def levels(
    scene: mi.Scene,
    materials: Materials,
    random: mi.Sampler,
    rays: list,
    first_hit: Callable,
    hide_emitters: bool,
    max_depth: int,
    rr_depth: int,
    frozen: Callable = call,
) -> Iterator[Level]:
    """Level after level of the paths that begin with ``rays``: (ray, importance, whether it is on the film) of each.

    The first one is the base path's. Each level is evaluated. ``frozen`` calls the functions that make kernels.
    """
    n = dr.width(rays[0][0].o)
    lanes, η, depth, numbers = dr.arange(mi.UInt32, n), dr.full(mi.Float, 1, n), 1, random.random
    paths = frozen(begun, scene, rays, first_hit, hide_emitters, fixed=True)
    while True:
        dr.eval(paths, lanes, η)
        yield Level(depth == 1, lanes, dr.opaque(mi.UInt32, depth, dr.width(lanes)), paths[0], paths[1:])
        if depth >= max_depth:
            return
        paths, η, numbers = frozen(onward, materials, paths, η, type(random)(numbers), depth >= rr_depth)
        dr.eval(paths, η, numbers)
        go_on = dr.compress(paths[0].alive)
        if not dr.width(go_on):
            return
        paths, lanes, η, numbers = frozen(further, scene, paths, lanes, η, numbers, go_on)
        dr.eval(paths, lanes, η, numbers)
        depth += 1


def begun(scene, rays: list, first_hit: Callable, hide_emitters: bool) -> list[Path]:
    """The paths of these rays up to what they hit."""
    paths = []
    for ray, importance, inside in rays:
        ray = mi.Ray3f(ray.o, ray.d, ray.time, ray.wavelengths)
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = dr.full(mi.Bool, not hide_emitters, dr.width(ray))
        β = mi.Spectrum(importance) + dr.zeros(mi.Spectrum, dr.width(ray))
        alive = inside & (mi.UInt32(0) == dr.zeros(mi.UInt32, dr.width(ray)))
        paths.append(Path(ray, first_hit(scene, ray), β, alive, sky_seen))
    return paths


def onward(materials: Materials, paths: list[Path], η, random, roulette: bool) -> tuple:
    """The paths behind their next event; with Russian ``roulette`` or without."""
    random = random.clone()
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    paths, etas = zip(*(scattered(path, materials, u_lobe, u_direction) for path in paths), strict=True)
    base, η = paths[0], dr.select(paths[0].alive, η * etas[0], η)
    if roulette:
        # All five survive together. As in ``path``: η² undoes what refraction does to radiance.
        brightest = mi.Float(0)
        for path in paths:
            brightest = dr.fmax(brightest, dr.select(path.alive, dr.max(path.β), 0))
        survival = dr.fmin(brightest * dr.square(η), 0.95)
        base.alive &= u_survival < survival
        for path in paths:
            path.β /= survival
    return list(paths), η, random.random


def scattered(path: Path, materials: Materials, u_lobe, u_direction) -> tuple[Path, mi.Float]:
    """A path behind its next event, its hit still unknown; and the relative index of refraction."""
    si = path.vertex()
    bsdf = si.bsdf()
    here = path.alive & si.is_valid()
    sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, here)
    kind = event_kind(sample.sampled_type)
    β = path.β * f_p
    # What is scattered widely is gathered, and the path ends.
    alive = here & (sample.pdf > 0) & ((kind != SMOOTH) | ~materials.connectable(bsdf)) & (dr.max(β) > 0)
    ray = si.spawn_ray(si.to_world(sample.wo))
    return Path(ray, path.hit, β, alive, path.sky_seen | (alive & (kind != NULL))), sample.eta


def further(scene, paths: list[Path], known, η, numbers, lanes: mi.UInt32) -> tuple:
    """What belongs to these ``lanes`` alone; and the paths up to what their rays hit."""

    def taken(value: Any):
        return dr.gather(type(value), value, lanes)

    found = []
    for path in paths:
        old = path.ray
        time = taken(old.time) if dr.width(old.time) > 1 else old.time
        wavelengths = taken(old.wavelengths) if dr.width(old.wavelengths) > 1 else old.wavelengths
        ray = mi.Ray3f(taken(old.o), taken(old.d), time, wavelengths)
        alive = taken(path.alive)
        hit = scene.ray_intersect_preliminary(ray, active=alive)
        found.append(Path(ray, hit, taken(path.β), alive, taken(path.sky_seen)))
    random = mi.PCG32()
    random.state, random.inc = taken(numbers.state), taken(numbers.inc)
    return found, taken(known), taken(η), random
