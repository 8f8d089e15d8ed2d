"""How photons and camera paths go through media: where they scatter next, and in what medium they begin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import segments
from data_gen.paths.media import Media, extinction, pick, vertex
from data_gen.samplers.bdpt.lights import LightEnds
from ngpt.errors import NgptError


class Fog:
    """The homogeneous media of a scene, one of which may be around its camera: ``within``.

    Raises NgptError, in the name of the ``sampler``, for media whose density varies, and where light from infinitely
    far away comes through a medium without end.
    """

    def __init__(self, scene: mi.Scene, lights: LightEnds, sampler: str):
        self.media = Media(scene)
        if self.media.grids:
            raise NgptError(
                f"sampler '{sampler}' cannot render this scene: there are media whose density varies; use --sampler gpt"
            )
        sensor = scene.sensors()[0]
        self.within = mi.MediumPtr(sensor.get_medium())
        self.eye = mi.Point3f(sensor.world_transform().translation())
        corner = mi.Point3f(scene.bbox().max) + float(np.linalg.norm(np.array(scene.bbox().extents())))
        outside = dr.reinterpret_array(mi.UInt32, self.around(scene, corner))[0]
        if outside and lights.emitters is not None and dr.any(lights.far(dr.arange(mi.UInt32, len(scene.emitters())))):
            raise NgptError(
                f"sampler '{sampler}' cannot render this scene: light from infinitely far away comes through a medium "
                "without end; put the medium into a shape, or use --sampler gpt"
            )

    @dr.syntax
    def around(self, scene, p: mi.Point3f) -> mi.MediumPtr:
        """The medium around points ``p``: lamps know of none, unless they are boundaries themselves.

        It is that on this side of the first boundary of media toward the camera, or the camera's if there is none.
        Other surfaces are in the same medium on both sides, and may be in the way.
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
        """The segment along ``ray``, and the vertex at its end; ``trace`` is that of ``segments.fly()``."""
        numbers = segments.draw(random, self.media)
        segment = segments.fly(self.media, trace, ray, medium, channel, numbers, active)
        return segment, vertex(segment.ray, segment.hit, segment.place)

    def ahead(self, trace, ray, medium, channel, random, active):
        """The vertex at the end of a camera path's segment, its place, and T over the density of its distance.

        σs is in the photons that are gathered there.
        """
        segment, x = self.fly(trace, ray, medium, channel, random, active)
        return x, segment.place, self.brought(segment, channel)

    def brought(self, segment: segments.Segment, channel) -> mi.Spectrum:
        """What ``ahead()`` has of a segment: its integrand over its density, without σs."""
        σ_c = pick(extinction(segment.place.medium, segment.ray), channel)
        # Where nothing is scattered, of a colour, photons have none of it either.
        weight = dr.select(segment.albedo > 0, segment.weight / (segment.albedo * σ_c), 0)
        return mi.Spectrum(dr.select(segment.place.scatters, weight, segment.weight))
