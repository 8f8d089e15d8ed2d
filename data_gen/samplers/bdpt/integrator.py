r"""Bidirectional path tracing: each camera sample traces a path from the camera and one from a light, and joins them.

Every way to find a path is a strategy. MIS weights combine all strategies (``mis``). Each vertex of the camera path is
connected to a lamp and to one vertex of the light path, which stands for all vertices of the light path
(``camera_path.choose``).

    z                 vertices of the camera path
    y                 vertices of the light path, kept while the camera path is traced
    s                 the number of a path's vertices that come from the light; each s is a strategy
    β                 throughput f / p of either path
    p, q              density of sampling a direction, and the same with both directions of the vertex swapped
    others            Σ p_j / p_s over all strategies j other than s, the strategy that found the path
    L, Le             radiance of the camera path: Le is emission that the camera sees directly, L is all other light

Both paths are made in one kernel. A light path that reaches the camera may end on any pixel, to which its light is
added (splatted). So samples of the same pass are not independent of each other. Paths of more than ``joined_depth``
edges are found only from the camera, by the strategies s = 0 and s = 1. This limits the memory for a light path, but
not the length of paths.

[Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation", chapter 10]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.film.splats import Splats
from data_gen.passes import SamplePass
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.eye import Sight
from data_gen.paths.features import features
from data_gen.paths.frozen import Frozen
from data_gen.paths.holes import Holes
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.bdpt.camera_path import camera_path
from data_gen.samplers.bdpt.light_path import Seen, light_path
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.common import GradientIntegrator


@dataclass
class Splatter:
    """The ``Visitor`` of light paths that splats their connections to the camera."""

    splats: Splats
    ray: mi.Ray3f
    importance: mi.Spectrum

    def start(self) -> None:
        return None

    def sees(self, state: None, seen: Seen) -> None:
        light = to_rgb(seen.C * self.importance / (1 + seen.others), self.ray.wavelengths)
        self.splats.add(seen.pixel, list(light), dr.max(seen.C) > 0)


class BDPT(GradientIntegrator):
    """Bidirectional path tracing, for surfaces; no gradients.

    Plugin ``bdpt``, with the parameters of Mitsuba's ``path`` and ``joined_depth``. Not handled: media, polarised
    variants, the material ``hair``, cameras that are neither perspective nor thin lenses, emitters other than areas,
    points, spots and those infinitely far away. Rendering a scene with any of these raises NgptError.
    """

    plan_class = Plan

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.longest = min(self.limits.max_depth, self.options["joined_depth"])

    def plan(self, world: World, **more) -> Plan:
        return self.plan_class(
            world.scene,
            world.lights,
            world.materials,
            holes=world.holes,
            limits=self.limits,
            longest=self.longest,
            first_hit=self.first_hit,
            hidden=self.hidden_from_camera,
            **more,
        )

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        plan = self.plan(World(scene, LightEnds(scene, self.name), holes=Holes.of(scene)))
        return partial(self.sample_pass, Frozen(scene, plan), plan)

    def sample_pass(self, frozen: Frozen, plan: Plan, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one path from the camera and one from a light for each camera sample."""
        splats = film.splats("primal") if plan.joins else None
        camera.look((0, 0), *QUARTERS)
        values, sums = frozen(self.samples, plan, camera, sums=splats and splats.zeros)
        if splats:
            splats.take(sums)
        film.put_all(values)

    def samples(self, plan: Plan, camera: CameraSamples, sums: tuple = ()) -> tuple[dict, tuple]:
        """Returns the layers, and the ``sums`` of splats with the splats of light paths added, if there are any."""
        sight, lit = Sight.of(camera), None
        if plan.joins:
            splatter = Splatter(Splats.on(sight.eye.pixels, 3, sums), sight.ray, sight.importance)
            lit, random, _ = light_path(plan, sight, splatter)
            sight = replace(sight, random=random)
        L, Le, _ = camera_path(plan, sight, lit)
        Le = self.emission_in_pixel(plan.scene, camera, Le)
        values = {"primal": to_rgb(L + Le, sight.ray.wavelengths), "direct": to_rgb(Le, sight.ray.wavelengths)}
        values |= features(plan.scene, camera.sensor, camera.random.clone(), sight.ray)
        return values, sums

    def hidden_from_camera(self, scene, si, camera: mi.DirectionSample3f, active) -> mi.Bool:
        """Whether the camera's near plane does not see ``si``. Hidden lamps block nothing, and are not seen."""
        if not self.hide_emitters:
            return scene.ray_test(si.spawn_ray_to(camera.p), active)
        on_lamp = si.emitter(scene) != None  # noqa: E711 - a comparison of arrays of pointers
        ray = si.spawn_ray_to(camera.p)
        hit = scene.ray_intersect_preliminary(ray, active=active & ~on_lamp)
        lamp = hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711
        behind = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, lamp).spawn_ray_to(camera.p)
        further = self.skip_area_emitters(scene, behind, False, lamp)
        blocked = dr.select(lamp, further.is_valid() & (further.t < behind.maxt), hit.is_valid())
        return on_lamp | blocked
