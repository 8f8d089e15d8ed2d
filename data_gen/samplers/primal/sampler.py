"""The scene's own integrator without gradients: references, and images for denoisers that need none."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features as feature_layers
from data_gen.paths.lights import emission_in_pixel, emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import radiance
from data_gen.samplers.gpt.integrator import stand_in
from data_gen.samplers.gpt.trace import trace
from data_gen.samplers.shared import VOLUMETRIC
from data_gen.scenes.facts import integrator_name
from data_gen.scenes.load import reference_integrator
from data_gen.scenes.places import Places


def make(scene: mi.Scene, features: bool, places: Places | None = None) -> SamplePass:
    """The sampler ``primal``; without ``features`` it holds the primal alone. Lamps may be chosen by ``places``."""
    integrator = reference_integrator(scene)
    followed = integrator_name(scene) in ("path", *VOLUMETRIC) and not mi.is_polarized
    L = radiance_by_place(scene, places) if places and followed else radiance(scene, integrator)
    return partial(sample_pass, scene, integrator, L, features)


def radiance_by_place(scene: mi.Scene, places: Places) -> Callable[..., mi.Spectrum]:
    """``radiance()`` by the base paths of ``gpt``: Mitsuba's integrators choose a lamp alike everywhere."""
    view = stand_in(scene, places, caustic=False)
    plan = view.plan(scene)

    def L(random, ray, medium, active) -> mi.Spectrum:
        within = mi.MediumPtr(medium) if plan.space.media else None
        paths = trace(view, plan, random, (ray, mi.Spectrum(1)), [], within)
        return paths.L + paths.Le

    return L


def sample_pass(scene, integrator, radiance, features: bool, camera: CameraSamples, film: GradientFilm) -> None:
    """One sample of ``radiance``, and of features, for each camera sample.

    Where ``features`` tell what is emission seen directly, that is the mean over a pixel's quarters.
    """
    ray, importance, _ = camera.rays()
    medium, all_lanes = camera.sensor.get_medium(), mi.Bool(True)
    L = importance * radiance(camera.random.clone(), ray, medium, all_lanes)
    if features:
        seen = partial(emission_seen, scene, integrator, medium, active=all_lanes)
        at_place = importance * seen(ray)
        Le = emission_in_pixel(scene, camera, at_place, seen)
        L = L + Le - at_place
        film.put("direct", to_rgb(Le, ray.wavelengths))
        film.put_all(feature_layers(scene, camera.sensor, camera.random.clone(), ray))
    film.put("primal", to_rgb(L, ray.wavelengths))
