"""Camera paths of a pixel and its neighbours through media, side by side from segment to segment: for ``gvpm``.

As ``camera``, but a segment ends where the path scatters in a medium, or on the surface behind. All paths replay the
random number that gives the optical depth of that event, in one colour for all. So they fly equally far in one medium,
and a path and its copy are the same numbers in two pixels: J = 1 and r = 1, wherever either of them ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.paths import media, segments
from data_gen.samplers.photons.passes import Start
from ngpt_studies.photons.gradients.camera import (
    CameraPaths,
    Level,
    Path,
    at_lanes,
    scattered,
    survive,
    taken,
)
from ngpt_studies.photons.media.vpm import brought


@dataclass
class Flight(Path):
    """A camera path behind a segment, whose last piece is ``ray``; β is for what is gathered at its end."""

    medium: mi.MediumPtr  # of the last piece
    scatters: mi.Bool  # in the medium, not on a surface

    def place(self) -> media.Place:
        return media.Place(self.medium, self.scatters)

    def vertex(self) -> mi.SurfaceInteraction3f:
        return media.vertex(self.ray, self.hit, self.place())

    def on_surface(self) -> Path:
        """The path, if it ends at a surface or nowhere."""
        return Path(self.ray, self.hit, self.β, self.alive & ~self.scatters, self.sky)


class PathsBySegments(CameraPaths):
    """The paths of ``gvpm``."""

    def begun(self, start: Level, random, rays: list) -> Level:
        random, flights, behind, fog = random.clone(), [], [], self.world.fog
        channel, numbers = media.choose_channel(random.next_1d()), segments.draw(random, fog.media)
        trace = partial(self.integrator.first_surface, self.world.scene, fog.media)
        for path in (self.first(*ray) for ray in rays):
            medium = dr.gather(mi.MediumPtr, fog.within, dr.zeros(mi.UInt32, dr.width(path.ray)))
            segment = segments.fly(fog.media, trace, path.ray, medium, channel, numbers, active=path.alive)
            flights.append(self.flight(path, segment, channel))
            if fog.media.grids:
                Le = self.integrator.behind_grids(self.world.scene, fog.media, segment)
                behind.append(flights[-1].β * Le * dr.select(path.alive, mi.Float(1), 0))
        return replace(start, paths=flights, numbers=random.state, channel=channel, behind=behind)

    def onward(self, level: Level, random) -> Level:
        """The paths behind their next event, in the medium that they go into."""
        random, η, after = random.clone(), level.η, []
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        for k, flight in enumerate(level.paths):
            # Photons are gathered where the path scatters in a medium, and the path ends.
            path, eta = scattered(flight.on_surface(), self.world.materials, u_lobe, u_direction)
            medium = flight.place().toward(flight.vertex(), path.ray.d)
            after.append(Flight(**vars(path), medium=medium, scatters=flight.scatters))
            if k == 0:
                η = dr.select(path.alive, η * eta, η)
        survive(after, u_survival, level.depth >= self.limits.rr_depth, η)
        return replace(level, paths=after, depth=level.depth + 1, η=η, numbers=random.state, behind=[])

    def further(self, level: Level, random, lanes: mi.UInt32) -> Level:
        random, media_of_scene, flights = random.at(lanes), self.world.fog.media, []
        channel, numbers = taken(level.channel, lanes), segments.draw(random, media_of_scene)
        trace = segments.next_surface(self.world.scene)
        for path in (at_lanes(flight, lanes) for flight in level.paths):
            medium = taken(path.medium, lanes)
            segment = segments.fly(media_of_scene, trace, path.ray, medium, channel, numbers, active=path.alive)
            flights.append(self.flight(path, segment, channel))
        return self.of_lanes(level, flights, random, lanes)

    def flight(self, path: Path, segment: segments.Segment, channel) -> Flight:
        β, place = path.β * brought(self.world.fog, segment, channel), segment.place
        return Flight(segment.ray, segment.hit, β, path.alive, path.sky, place.medium, place.scatters)

    def direct(self, level: Level, start: Start, frozen: Callable) -> mi.Spectrum:
        return frozen(self.seen_directly, mi.Ray3f(start.ray), start.importance)

    def seen_directly(self, ray: mi.Ray3f, importance) -> mi.Spectrum:
        fog = self.world.fog
        return importance * self.integrator.lamps_in_fog(self.world.scene, fog.media, ray, fog.within, mi.UInt32(0))

    def at_surfaces(self, level: Level, frozen: Callable) -> list[Path]:
        paths = frozen(on_surfaces, level.paths)
        dr.eval(paths)
        return paths


def on_surfaces(flights: list[Flight]) -> list[Path]:
    return [flight.on_surface() for flight in flights]
