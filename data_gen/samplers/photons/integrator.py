"""The base class of all photon plugins: parameters, the world of a scene, and the photon maps of a pass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.passes import SamplePass
from data_gen.paths import media
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.lights import visible
from data_gen.paths.streams import light_streams
from data_gen.paths.vertex import Materials
from data_gen.samplers.common import GradientIntegrator
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.radius import pixel_width, shrunk
from data_gen.samplers.photons.map.trace import MAP_BYTES, VERTICES_PER_PATH, trace
from data_gen.samplers.photons.passes import Passes
from ngpt.errors import NgptError

# Bytes of a camera sample and its features, without the maps
CAMERA_BYTES = 256
# Bytes of a map in media: one more word for each vertex and two for each light path, all of them twice, as in MAP_BYTES
MEDIA_MAP_BYTES = MAP_BYTES + VERTICES_PER_PATH * 8 + 2 * 8
# Additional bytes in scenes with grids: Φ / σs of each vertex
GRID_BYTES = VERTICES_PER_PATH * 3 * 4


@dataclass
class Traced:
    """The photon map of a pass."""

    photons: Any  # the vertices of light paths, see ``map.vertices``
    paths: int  # number of light paths of the pass
    number: int  # number of the pass
    seed: int  # seed of the render
    first_radius: float  # the gathering radius in pass 0

    def radius(self, dimension: int = 2) -> float:
        """The radius of this pass, for photons that are gathered in a disk (``dimension`` 2) or a ball (3)."""
        return self.first_radius * shrunk(self.number, dimension)


class PhotonIntegrator(GradientIntegrator):
    """An integrator with photon maps. Derived classes define ``sample_pass(passes, camera, film)``, and the attributes

    ``follows``       "volpath" if they render media, or "path" for surfaces only
    ``camera_bytes``  memory of a camera sample
    ``map_bytes``     memory of a map for each light path, and ``grid_bytes`` more in scenes with grids
    """

    camera_bytes, map_bytes, grid_bytes = CAMERA_BYTES, MAP_BYTES, GRID_BYTES

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.photons = self.options["photons"]

    @property
    def lane_bytes(self) -> int:
        """Bytes of a camera sample, with the largest map of its light paths."""
        return self.camera_bytes + self.photons * self.map_bytes

    def instead(self, lane_bytes: int) -> str:
        """Advice, besides a smaller image, that makes a camera sample fit into ``lane_bytes``; "" if there is none."""
        fits = (lane_bytes - self.camera_bytes) // self.map_bytes
        return f", or no more than -O photons={fits}" if fits > 0 else ""

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        lights = LightEnds(scene, self.name)
        _refuse_lamps_never_chosen(scene, self.name)
        fog = Fog(scene, sensor, lights, self.name) if self.follows == "volpath" else None
        if fog and fog.media.grids:
            self.map_bytes = type(self).map_bytes + self.grid_bytes
        passed = {"passed": media.index_matched, "media": True} if fog else {}
        materials = Materials(scene, self.options["roughness_threshold"], **passed)
        world = World(scene, lights, materials, fog)
        return Passes(self, world, pixel_width(scene, sensor))

    def maps(self, passes: Passes, camera: CameraSamples) -> Iterator[Traced]:
        """Yields the photon maps of the pass, which has ``photons`` light paths for each sample of the ``camera``."""
        world, limits = passes.world, self.limits
        if world.lights.emitters is None or limits.max_depth <= 1:
            return
        n = dr.width(camera.pixel) * self.photons
        random = light_streams(camera.seed, dr.arange(mi.UInt32, n), camera.first, independent=not camera.net)
        for photons in trace(world, random, limits.max_depth - 1, limits.rr_depth, passes.frozen):
            yield Traced(photons, n, camera.first, camera.seed, self.options["radius"] * passes.width)


def _refuse_lamps_never_chosen(scene, sampler: str) -> None:
    """Raises NgptError for visible lamps of weight 0. No photons start there, so their light would be missing, while
    Mitsuba's paths meet such lamps by chance. Points and single directions of weight 0 are dark in Mitsuba as well.
    """
    for index, emitter in enumerate(scene.emitters()):
        if visible(emitter) and scene.pdf_emitter(mi.UInt32(index))[0] == 0:
            raise NgptError(
                f"sampler '{sampler}' cannot render this scene: no photons would start at emitter "
                f"'{emitter.id()}', which has sampling_weight 0; give it a positive one, or use --sampler gpt"
            )
