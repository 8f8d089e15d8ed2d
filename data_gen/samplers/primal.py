"""The scene's own integrator without gradients: references, and images for denoisers that need none."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features as feature_layers
from data_gen.paths.lights import emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.scenes.load import path_depths, reference_integrator


def make(scene: mi.Scene, features: bool = True) -> SamplePass:
    """The sampler ``primal``; without ``features`` it holds the primal alone."""
    integrator = reference_integrator(scene)
    return partial(sample_pass, scene, integrator, radiance(scene, integrator), features)


def radiance(scene: mi.Scene, integrator: mi.SamplingIntegrator) -> Callable[..., mi.Spectrum]:
    """(sampler, ray, medium) -> what the integrator estimates: itself, or Mitsuba's ``prb`` where ``path`` is biased.

    ``path`` returns 0 for a path that has escaped after holes alone, were it lit by emitter sampling where the material
    of a mask is there in part; but for scenes with an environment.
    """
    holes = any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null) for shape in scene.shapes() if shape.bsdf())
    depths = path_depths(integrator) if integrator.class_name() == "PathIntegrator" else {}
    if holes and depths and not scene.environment() and not integrator.hide_emitters:
        prb = mi.load_dict({"type": "prb", **depths})
        return lambda sampler, ray, medium: prb.sample(
            dr.ADMode.Primal, scene, sampler, ray, None, None, mi.Bool(True)
        )[0]
    return lambda sampler, ray, medium: integrator.sample(scene, sampler, ray, medium)[0]


def sample_pass(scene, integrator, radiance, features: bool, camera: CameraSamples, film: GradientFilm) -> None:
    """One sample of radiance, and of features, for each camera sample, by Mitsuba's integrator alone."""
    ray, importance, _ = camera.rays()
    L = radiance(camera.random.clone(), ray, camera.sensor.get_medium())
    film.put("primal", to_rgb(L * importance, ray.wavelengths))
    if features:
        Le = emission_seen(scene, integrator, camera.sensor.get_medium(), ray, mi.Bool(True))
        film.put("direct", to_rgb(Le * importance, ray.wavelengths))
        film.put_all(feature_layers(scene, camera.sensor, camera.random.clone(), ray))
