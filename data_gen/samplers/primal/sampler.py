"""The scene's own integrator without gradients, for references and for denoisers that need no gradients."""

from __future__ import annotations

from functools import partial

import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.features import features as feature_layers
from data_gen.paths.frozen import Frozen
from data_gen.paths.lights import emission_in_pixel, emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import loses_light, radiance, recorded
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.gpt.rounds import sharing
from data_gen.samplers.gpt.trace import trace
from data_gen.samplers.registry import SAMPLERS
from data_gen.samplers.shared import PATHS
from data_gen.scenes.facts import integrator_name
from data_gen.scenes.lamps import Places
from data_gen.scenes.load import reference_integrator
from data_gen.scenes.lost import bent_lamp
from data_gen.tails.cache import Known


def make(scene: mi.Scene, features: bool, tails: str = "paths", places: Places | None = None) -> SamplePass:
    """Makes the sampler ``primal``. Without ``features`` it renders only the primal. ``places`` chooses lamps by place.

    With ``tails`` "shared", paths may end in a cache of light, see ``data_gen.tails``.
    """
    integrator = reference_integrator(scene)
    followed = integrator_name(scene) in PATHS and not mi.is_polarized
    errs = places or loses_light(scene, integrator) or bent_lamp(scene)
    if not (tails == "shared" or (followed and errs)):
        return recorded(scene, partial(samples, scene, integrator, radiance(scene, integrator), features))
    # Here the paths of ``gpt`` replace Mitsuba's. Mitsuba's integrators choose lamps with the same probabilities
    # everywhere, and have wrong densities for lamps with vertex normals. In scenes with holes, where ``path`` loses
    # light, our paths trace a quarter fewer rays than ``prb``.
    view = SAMPLERS["gpt"].integrator(scene, places=places, caustic=False, tails=tails)
    plan = view.plan(scene)
    frozen = Frozen(scene, plan)
    of_camera = partial(our_samples, view, plan, integrator=integrator, features=features)

    def take(known: Known | None, camera: CameraSamples, film: GradientFilm) -> None:
        film.put_all(frozen(of_camera, camera.look((0, 0), *QUARTERS), known))

    return sharing(view, plan, frozen, take)


def our_samples(view, plan: Plan, camera: CameraSamples, known: Known | None, *, integrator, features: bool) -> dict:
    """As ``samples()``, with the base paths of ``gpt``. They may end where the cache has ``known`` light.

    If paths may end in a cache, there is a layer ``shared``: a sample of the error of the light from the cache.
    """
    errors = []

    def radiance(random, ray, medium, active) -> mi.Spectrum:
        within = mi.MediumPtr(medium) if plan.space.media else None
        paths = trace(view, plan, random, (ray, mi.Spectrum(1)), [], within, known=known)
        errors.append(paths.shared)
        return paths.L + paths.Le

    layers = samples(plan.space.scene, integrator, radiance, features, camera)
    if plan.matt:
        ray, importance, _ = camera.rays()
        layers["shared"] = to_rgb(importance * errors[0], ray.wavelengths)
    return layers


def samples(scene, integrator, radiance, features: bool, camera: CameraSamples) -> dict:
    """Returns layers: for each camera sample, one sample of ``radiance`` and, if wanted, of ``features``.

    With ``features``, directly seen emission is the mean over the quarters of a pixel.
    """
    ray, importance, _ = camera.rays()
    medium, all_lanes = camera.sensor.get_medium(), mi.Bool(True)
    L = importance * radiance(camera.random.clone(), ray, medium, all_lanes)
    layers = {}
    if features:
        seen = partial(emission_seen, scene, integrator, medium, active=all_lanes)
        at_place = importance * seen(ray)
        Le = emission_in_pixel(scene, camera, at_place, seen)
        L = L + Le - at_place
        layers["direct"] = to_rgb(Le, ray.wavelengths)
        layers |= feature_layers(scene, camera.sensor, camera.random.clone(), ray)
    return layers | {"primal": to_rgb(L, ray.wavelengths)}
