"""Camera paths of a pixel and its neighbours through media, side by side from segment to segment: for ``gvpm``.

As ``camera``, but a segment ends where the path scatters in a medium, or on the surface behind. All paths replay the
number that says at what optical depth that is, in one colour for all of them. So they fly equally far in one medium,
and a path and its copy are the same numbers in two pixels: J = 1 and r = 1, wherever either of them ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import media, segments
from data_gen.paths.vertex import Materials
from data_gen.samplers.photons.gradients.camera import Level, Path, scattered
from data_gen.samplers.photons.map.fog import Fog


@dataclass
class Flight(Path):
    """A camera path behind a segment, of which ``ray`` is the last piece; β is that of what is gathered at its end."""

    medium: mi.MediumPtr  # of the last piece
    scatters: mi.Bool  # in the medium, not on a surface

    def place(self) -> media.Place:
        return media.Place(self.medium, self.scatters)

    def vertex(self) -> mi.SurfaceInteraction3f:
        return media.vertex(self.ray, self.hit, self.place())

    def on_surface(self) -> Path:
        """The path, if it ends at a surface or nowhere."""
        return Path(self.ray, self.hit, self.β, self.alive & ~self.scatters, self.sky_seen)


@dataclass
class FlightLevel(Level):
    """Paths behind ``depth`` segments."""

    camera: tuple  # the base paths' first rays, and their importance, of all camera samples
    behind: list  # behind the first segment what each path has seen through grids, if there are any


def levels_by_segments(
    scene: mi.Scene,
    fog: Fog,
    materials: Materials,
    random: mi.Sampler,
    rays: list,
    first_surface: Callable,
    behind_grids: Callable,
    hide_emitters: bool,
    max_depth: int,
    rr_depth: int,
    frozen: Callable,
) -> Iterator[FlightLevel]:
    """As ``camera.levels()``; ``first_surface`` (scene, ray, medium, active) is what camera rays themselves meet.

    ``behind_grids`` (scene, media, segment) is Le that a first segment leads to, through grids.
    """
    n = dr.width(rays[0][0].o)
    lanes, η, depth, stream = dr.arange(mi.UInt32, n), dr.full(mi.Float, 1, n), 1, type(random)
    seen = first_surface, behind_grids, hide_emitters
    paths, behind, channel, numbers = frozen(begun, scene, fog, random, rays, *seen, fixed=True)
    while True:
        dr.eval(paths, behind, channel, numbers, lanes, η)
        depths = dr.opaque(mi.UInt32, depth, dr.width(lanes))
        yield FlightLevel(depth == 1, lanes, depths, paths[0], paths[1:], rays[0][:2], behind)
        if depth >= max_depth:
            return
        paths, η, numbers = frozen(onward, materials, paths, η, stream(numbers), depth >= rr_depth)
        dr.eval(paths, η, numbers)
        go_on = dr.compress(paths[0].alive)
        if not dr.width(go_on):
            return
        known = lanes, η, channel
        paths, lanes, η, channel, numbers = frozen(further, scene, fog, paths, known, stream(numbers), go_on)
        depth, behind = depth + 1, []


def begun(
    scene, fog: Fog, random, rays: list, first_surface: Callable, behind_grids: Callable, hide_emitters: bool
) -> tuple:
    """The paths of these rays, (ray, importance, whether it is on the film) of each, behind their first segment."""
    random, paths, behind = random.clone(), [], []
    channel, numbers = media.choose_channel(random.next_1d()), segments.draw(random, fog.media)
    for ray, importance, inside in rays:
        ray, n = mi.Ray3f(ray.o, ray.d, ray.time, ray.wavelengths), dr.width(ray)
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = dr.full(mi.Bool, not hide_emitters, n)
        β = mi.Spectrum(importance) + dr.zeros(mi.Spectrum, n)
        alive = inside & (mi.UInt32(0) == dr.zeros(mi.UInt32, n))
        medium = dr.gather(mi.MediumPtr, fog.within, dr.zeros(mi.UInt32, n))
        trace = partial(first_surface, scene)
        segment = segments.fly(fog.media, trace, ray, medium, channel, numbers, alive)
        paths.append(flight(fog, segment, β, alive, sky_seen, channel))
        if fog.media.grids:
            behind.append(paths[-1].β * behind_grids(scene, fog.media, segment) * dr.select(alive, mi.Float(1), 0))
    return paths, behind, channel, random.random


def flight(fog: Fog, segment: segments.Segment, β, alive, sky_seen, channel) -> Flight:
    """The path that goes on by that ``segment``."""
    place = segment.place
    return Flight(
        segment.ray, segment.hit, β * fog.brought(segment, channel), alive, sky_seen, place.medium, place.scatters
    )


def onward(materials: Materials, paths: list[Flight], η, random, roulette: bool) -> tuple:
    """The paths behind their next event, in the medium that they go into; with Russian ``roulette`` or without."""
    random, after = random.clone(), []
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    for k, flight in enumerate(paths):
        # What is scattered in a medium is gathered, and the path ends.
        path, eta = scattered(flight.on_surface(), materials, u_lobe, u_direction)
        medium = flight.place().toward(flight.vertex(), path.ray.d)
        after.append(Flight(path.ray, path.hit, path.β, path.alive, path.sky_seen, medium, flight.scatters))
        if k == 0:
            η = dr.select(path.alive, η * eta, η)
    if roulette:
        # All five survive together. As in ``path``: η² undoes what refraction does to radiance.
        brightest = mi.Float(0)
        for path in after:
            brightest = dr.fmax(brightest, dr.select(path.alive, dr.max(path.β), 0))
        survival = dr.fmin(brightest * dr.square(η), 0.95)
        after[0].alive &= u_survival < survival
        for path in after:
            path.β /= survival
    return after, η, random.random


def further(scene, fog: Fog, paths: list[Flight], known: tuple, random, go_on: mi.UInt32) -> tuple:
    """What belongs to the lanes ``go_on`` alone; and the paths behind their next segment."""

    def taken(value: Any):
        return dr.gather(type(value), value, go_on)

    random = random.at(go_on)
    (lanes, η, channel), numbers = (taken(value) for value in known), segments.draw(random, fog.media)
    found = []
    for path in paths:
        old = path.ray
        time = taken(old.time) if dr.width(old.time) > 1 else old.time
        wavelengths = taken(old.wavelengths) if dr.width(old.wavelengths) > 1 else old.wavelengths
        ray = mi.Ray3f(taken(old.o), taken(old.d), time, wavelengths)
        alive, medium = taken(path.alive), taken(path.medium)
        segment = segments.fly(fog.media, segments.next_surface(scene), ray, medium, channel, numbers, alive)
        found.append(flight(fog, segment, taken(path.β), alive, taken(path.sky_seen), channel))
    return found, lanes, η, channel, random.random
