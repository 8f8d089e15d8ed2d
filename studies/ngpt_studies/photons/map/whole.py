"""The photon maps of a pass, with light paths: what samplers trace that copy photons, or gather beams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightRay
from data_gen.paths.streams import light_streams
from data_gen.samplers.photons import integrator
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.map.trace import MAP_BYTES, VERTICES_PER_PATH, trace

# Bytes of a map in media: two words more for each vertex, and two for each light path
MEDIA_MAP_BYTES = MAP_BYTES + VERTICES_PER_PATH * 2 * 8 + 2 * 8
# Further bytes of it with grids: null collisions of each vertex, twice
GRID_BYTES = integrator.GRID_BYTES + VERTICES_PER_PATH * (3 + 3) * 4


@dataclass
class Traced(integrator.Traced):
    starts: LightRay  # the light's end of each light path


def whole_maps(
    sampler: integrator.PhotonIntegrator, passes: Passes, camera: CameraSamples, edges: bool = False
) -> Iterator[Traced]:
    """``PhotonIntegrator.maps()``, whose vertices know their light paths, with their ``edges`` if these are wanted."""
    world, limits = passes.world, sampler.limits
    if world.lights.emitters is None or limits.max_depth <= 1:
        return
    n, radius = dr.width(camera.pixel) * sampler.photons, sampler.options["radius"] * passes.width
    random = light_streams(camera.seed, dr.arange(mi.UInt32, n), camera.first, independent=not camera.net)
    starts, maps = trace(world, random, limits.max_depth - 1, limits.rr_depth, frozen=passes.frozen, edges=edges)
    for photons in maps:
        yield Traced(photons, n, camera.first, camera.seed, radius, starts)
