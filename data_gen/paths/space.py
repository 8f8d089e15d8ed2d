"""The space between the surfaces of a scene: empty, or filled with media. Only the paths of ``gpt`` use it.

The kernel of a scene without media contains no code for media. In such a scene a vertex has no ``Place``, a path draws
no random numbers for its segments, and a segment is the ray to the next surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import media, segments
from data_gen.paths.holes import Holes
from data_gen.paths.media import Media, Place, index_matched
from data_gen.paths.segments import Numbers, Segment


@dataclass
class Drawn:
    """Random numbers of a path for one step through media."""

    channel: mi.UInt32  # the colour by which the path samples its distances, the same in all steps
    numbers: Numbers  # for the segment
    light: mi.UInt32 | None  # the key of the random numbers for the way to the emitter; None without grids


class Space:
    """Empty: light goes straight from surface to surface."""

    media: Media | None = None
    grids = False  # whether there are media whose density varies

    def __init__(self, scene: mi.Scene):
        self.scene = scene
        self.holes = Holes.of(scene, self.passed)  # None where there are none

    def passed(self, shape: mi.Shape) -> bool:
        return False

    def begin(self, random) -> Drawn | None:
        return None

    def draw(self, random, channel: mi.UInt32 | None) -> Drawn | None:
        """Random numbers for one more step of a path that samples distances by colour ``channel``."""
        return None

    def first(self, view, ray, within, drawn: Drawn | None) -> Segment:
        """The segment from a camera ``within`` a medium. ``view`` is the integrator, which may hide lamps."""
        return straight(ray, view.first_hit(self.scene, ray))

    def fly(self, x, place: Place | None, ray, drawn: Drawn | None, active) -> Segment:
        return straight(ray, self.scene.ray_intersect_preliminary(ray, active=active))

    def around(self, sensor: mi.Sensor) -> mi.MediumPtr | None:
        """The medium around a camera; None in empty space."""
        return None

    def length(self, origin: mi.Point3f, x) -> mi.Float:
        """The length of the whole segment from ``origin`` to the vertex ``x``; infinite if ``x`` is not valid."""
        return x.t

    def end(self, x, segment: Segment) -> mi.SurfaceInteraction3f:
        return media.vertex(segment.ray, segment.hit, segment.place)

    def sees(
        self, x, place: Place | None, target: mi.Point3f, drawn: Drawn | None, active, *, most: Any
    ) -> tuple[Any, mi.Bool]:
        """Transmittance from vertex ``x`` to the point ``target`` of an emitter, and whether it is above 0.

        There may be at most ``most`` holes on the way.
        """
        if self.holes is None:
            return 1, ~self.scene.ray_test(x.spawn_ray_to(target), active)
        T, _ = self.holes.transmittance(self.scene, x.spawn_ray_to(target), target, most, active)
        return T, dr.max(T) > 0

    def reconnect(
        self, y, place: Place | None, ray, x1, base: Segment, drawn: Drawn | None, *, active
    ) -> tuple[Any, Any, mi.Bool]:
        """Reconnects the segment ``base`` along ``ray``, from ``y`` to ``x1``: see ``segments.reconnect``."""
        return 1, 1, self.scene.ray_test(ray, active)


def straight(ray, hit: mi.PreliminaryIntersection3f) -> Segment:
    return Segment(ray, hit, place=None, weight=1, albedo=1, τ_c=0, nulls=None)


class Filled(Space):
    """Filled with media: vertices may be in them, and they absorb and scatter light on its way."""

    def __init__(self, scene: mi.Scene):
        super().__init__(scene)
        self.media = Media(scene)
        self.grids = self.media.grids

    def passed(self, shape: mi.Shape) -> bool:
        return index_matched(shape)

    def begin(self, random) -> Drawn:
        return Drawn(media.choose_channel(random.next_1d()), segments.draw(random, self.media), None)

    def draw(self, random, channel: mi.UInt32) -> Drawn:
        return Drawn(channel, segments.draw(random, self.media), random.next_key() if self.grids else None)

    def first(self, view, ray, within, drawn: Drawn) -> Segment:
        trace = partial(view.first_surface, self.scene, self.media)
        return segments.fly(self.media, trace, ray, within, drawn.channel, drawn.numbers, active=mi.Bool(True))

    def fly(self, x, place: Place, ray, drawn: Drawn, active) -> Segment:
        trace, medium = segments.next_surface(self.scene), place.toward(x, ray.d)
        return segments.fly(self.media, trace, ray, medium, drawn.channel, drawn.numbers, active=active)

    def around(self, sensor: mi.Sensor) -> mi.MediumPtr:
        return mi.MediumPtr(sensor.get_medium())

    def length(self, origin: mi.Point3f, x) -> mi.Float:
        # x.t is the length of the last piece.
        return dr.select(x.is_valid(), dr.norm(x.p - origin), x.t)

    def end(self, x, segment: Segment) -> mi.SurfaceInteraction3f:
        x1 = super().end(x, segment)
        x1.t = self.length(x.p, x1)
        return x1

    def sees(
        self, x, place: Place, target: mi.Point3f, drawn: Drawn, active, *, most: Any
    ) -> tuple[mi.Spectrum, mi.Bool]:
        numbers = {"channel": drawn.channel, "key": drawn.light}
        if self.holes is None:
            T = segments.transmittance(self.scene, self.media, x, place, target, **numbers, active=active)
        else:
            way = {"holes": self.holes, "most": most} | numbers
            T = segments.through_holes(self.scene, self.media, x, place, target, **way, active=active)
        return T, dr.max(T) > 0

    def reconnect(
        self, y, place: Place, ray, x1, base: Segment, drawn: Drawn, *, active
    ) -> tuple[mi.Spectrum, mi.Float, mi.Bool]:
        of_base = {"x1": x1, "base": base, "channel": drawn.channel}
        return segments.reconnect(self.scene, self.media, y, place, ray, **of_base, active=active)
