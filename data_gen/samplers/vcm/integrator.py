r"""Vertex connection and merging: ``bdpt`` and ``ppm`` in one sampler, combined by MIS weights.

    s, t        the number of vertices of a path that come from the light, and from the camera
    z, y        vertices of the camera path and of light paths
    r, η        the radius of gathering in a pass, and π r² N with N light paths in the pass

A pass has one camera sample and one light path for each pixel. Light paths are traced once. Their vertices are
connected to the camera (splats) and kept in a map. Each vertex of a camera path is connected to one vertex of the same
sample's light path (``bdpt.camera_path``). The vertices of all light paths are also gathered as photons, within the
radius, at the vertices of camera paths where materials scatter widely. Only vertices that light reaches from mirrors or
clear glass are photons (docs/samplers/photons.md). The light of photons is the layer ``caustic``
(``ngpt.layers.GATHERED``).

[Georgiev et al. 2012, "Light Transport Simulation with Vertex Connection and Merging"; Hachisuka et al. 2012, "A Path
Space Extension for Robust Light Transport Simulation"]
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.film.splats import Splats
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Sight
from data_gen.paths.features import features
from data_gen.paths.holes import Holes
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import Materials
from data_gen.samplers.bdpt.camera_path import camera_path
from data_gen.samplers.bdpt.integrator import BDPT, Splatter
from data_gen.samplers.bdpt.light_path import light_path
from data_gen.samplers.photons.map.radius import number_of, pixel_width, shrunk
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.vcm.merging import VERTEX_BYTES, Keeper, Map, Merging, Photons, eta

# Bytes of a camera sample, its features and its light path, without the map: measured, with a margin
SAMPLE_BYTES = 1536


class VCM(BDPT):
    """Vertex connection and merging, for surfaces; no gradients.

    Plugin ``vcm``, with the parameters of Mitsuba's ``path`` and the options of its entry. It is biased and consistent,
    as ``ppm`` is, but the bias is only in light that comes through glass or from mirrors. Not handled: media, polarised
    and spectral variants, and what ``bdpt`` does not handle. Rendering a scene with any of these raises NgptError.
    """

    # The visitor that receives light paths that end at the camera
    splatter = Splatter
    sample_bytes = SAMPLE_BYTES

    @property
    def vertices(self) -> int:
        return max(self.longest - 1, 0)

    @property
    def lane_bytes(self) -> int:
        """Bytes of a camera sample, with the largest map of its light path."""
        # Dr.Jit rounds the size of each array up to a power of two.
        places = 1 << (self.vertices - 1).bit_length() if self.vertices else 0
        return self.sample_bytes + places * VERTEX_BYTES

    def instead(self, lane_bytes: int) -> str:
        """Advice, besides a smaller image, that makes a camera sample fit into ``lane_bytes``; "" if there is none."""
        places = (lane_bytes - self.sample_bytes) // VERTEX_BYTES
        fits = 1 + (1 << (places.bit_length() - 1)) if places > 0 else 0
        return f", or no more than -O joined_depth={fits}" if fits else ""

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        materials = Materials(scene, self.options["roughness_threshold"])
        world = World(scene, LightEnds(scene, self.name), materials, holes=Holes.of(scene))
        return Passes(self, world, pixel_width(scene, sensor))

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """Traces one light path and one camera path for each camera sample. Each pixel has one sample."""
        world, frozen, sight, photons = passes.world, passes.frozen, Sight.of(camera), None
        dr.eval(sight.ray, sight.importance)
        values = frozen(features, world.scene, camera.sensor, camera.random.clone(), sight.ray)
        if self.plan(world).joins:
            photons, sight, _ = self.light_pass(passes, sight, camera, film.splats("primal"))
        L, Le, L_merged = frozen(self.camera_pass, world, sight, photons)
        layers = {"primal": L + Le, "direct": Le, "caustic": L_merged}
        values |= {name: to_rgb(light, sight.ray.wavelengths) for name, light in layers.items()}
        dr.eval(values)
        film.put_all(values)

    # ----------------------- Light paths: splats, and photons ------------------------

    def light_pass(
        self, passes: Passes, sight: Sight, camera: CameraSamples, splats: Splats
    ) -> tuple[Photons, Sight, Any]:
        """Traces the light paths of a pass and splats their connections to the camera. Returns the vertices as photons,
        the ``sight`` with the remaining random numbers, and the splatter's state."""
        n, radius = dr.width(sight.ray), self.options["radius"] * passes.width * shrunk(camera.first)
        η, empty = dr.opaque(mi.Float, eta(radius, n)), Map.empty(n, self.vertices)
        kept, numbers, state, sums = passes.frozen(self.light_paths, passes.world, sight, η, empty, sums=splats.zeros)
        dr.eval(kept, numbers, state, sums)
        splats.take(sums)
        photons = Photons(kept, radius, n, number_of(camera.seed, camera.first))
        return photons, replace(sight, random=type(sight.random)(numbers)), state

    def light_paths(self, world: World, sight: Sight, η: mi.Float, empty: Map, sums: tuple) -> tuple:
        """Fills the ``empty`` map and the ``sums`` of splats. Returns the map, the state of the random numbers, the
        splatter's state, and the sums."""
        splatter = self.splatter(Splats.on(sight.eye.pixels, 3, sums), sight.ray, sight.importance)
        path, random, state = light_path(self.plan(world, η=η), sight, Keeper(splatter, η, empty))
        return replace(empty, count=path.count), random.state, state, sums

    # ------------------------ Camera paths: joins, and merges ------------------------

    def camera_pass(self, world: World, sight: Sight, photons: Photons | None) -> tuple:
        """Returns L, Le and L_merged of camera paths, joined to their own light paths and merged with ``photons``."""
        sight = replace(sight, random=sight.random.clone())
        if photons is None:
            return camera_path(self.plan(world), sight, None)
        plan = self.plan(world, η=photons.η)
        return camera_path(plan, sight, photons.kept.paths(), Merging(photons, plan))
