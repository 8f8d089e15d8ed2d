"""How photons and camera paths go through media: where they scatter next, and in which medium they start."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import segments
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.media import Media, vertex
from ngpt.errors import NgptError


class Fog:
    """The media of a scene. ``within`` is the medium around the camera ``sensor``, or none.

    Raises NgptError, with the name of the ``sampler``, if light from infinitely far away comes through a medium without
    bounds.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, lights: LightEnds, sampler: str):
        self.media = Media(scene)
        self.within = mi.MediumPtr(sensor.get_medium())
        # The start of a camera ray. For a meter on a shape, or a meter infinitely far away, to_world does not give this
        # point.
        middle = mi.Point2f(0.5)
        self.eye = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, middle, middle)[0].o
        corner = mi.Point3f(scene.bbox().max) + float(np.linalg.norm(np.array(scene.bbox().extents())))
        outside = dr.reinterpret_array(mi.UInt32, self.around(scene, corner))[0]
        if outside and lights.emitters is not None and dr.any(lights.far(dr.arange(mi.UInt32, len(scene.emitters())))):
            raise NgptError(
                f"sampler '{sampler}' cannot render this scene: light from infinitely far away comes through a medium "
                "without end; put the medium into a shape, or use --sampler gpt"
            )

    @dr.syntax
    def around(self, scene, p: mi.Point3f) -> mi.MediumPtr:
        """The medium around points ``p``. Mitsuba does not know the medium of a lamp that is not a boundary itself.

        The first boundary on the way from ``p`` to the camera gives the medium on the side where ``p`` is. If there is
        no boundary, the medium is the camera's. Other surfaces on the way have the same medium on both sides.
        """
        to = self.eye - p
        distance = dr.norm(to)
        ray = mi.Ray3f(mi.Point3f(p), to / distance, distance, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths)
        medium = dr.gather(mi.MediumPtr, self.within, dr.zeros(mi.UInt32, dr.width(p)))
        searching = dr.full(mi.Bool, True, dr.width(p))
        while dr.hint(searching, label="medium of lamps"):
            si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, searching)
            found = searching & si.is_valid() & si.is_medium_transition()
            medium = dr.select(found, si.target_medium(-ray.d), medium)
            searching &= si.is_valid() & ~found
            left = ray.maxt - si.t
            ray = si.spawn_ray(ray.d)
            ray.maxt = left
        return medium

    def fly(self, trace, ray, medium, channel, random, active):
        """The segment along ``ray``, and the vertex at its end; ``trace`` as in ``segments.fly()``."""
        numbers = segments.draw(random, self.media)
        segment = segments.fly(self.media, trace, ray, medium, channel, numbers, active=active)
        return segment, vertex(segment.ray, segment.hit, segment.place)

    def power(self, photons) -> mi.Spectrum:
        """Returns the weight of each photon of a map in media. It is the power Φ that is scattered at the photon, or
        Φ / σs in scenes with grids, where σs is the scattering coefficient.

        The sum of Φ / σs over a volume is the light that goes through it. This light is smooth, even where σs is not.
        It is multiplied by σs only where the camera path scatters, so the density of a grid is not blurred.
        """
        if not self.media.grids:
            return photons.β
        scatters = (photons.depth > 0) & (dr.squared_norm(photons.n) == 0)
        here = dr.zeros(mi.MediumInteraction3f, len(photons))
        here.p, here.medium = photons.p, photons.medium
        σs, _, _ = photons.medium.get_scattering_coefficients(here, scatters)
        return mi.Spectrum(dr.select(scatters & (σs > 0), photons.β / σs, 0))
