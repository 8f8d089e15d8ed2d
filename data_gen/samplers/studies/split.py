"""A path tracer whose light is in two layers, by the lobe of its first scattering event: diffuse and specular.

Kernel-predicting networks denoise the two apart [Bako et al. 2017, "Kernel-Predicting Convolutional Networks for
Denoising Monte Carlo Renderings", section 5.1]. Light that reaches the camera in several lobes of one vertex is shared
between the layers in proportion to them, f_diffuse / f (``Lobes``), by whichever technique it was found: that has less
noise than to go by the lobe which was sampled, and the same mean. The rest, mirrors, glass, gloss, and emission seen
through holes, is specular. Neither layer holds emission that the camera sees directly:

    primal = direct + diffuse + specular

Holes (null events) are no scattering. Paths are sampled as by Mitsuba's ``path``, steps taken as in ``gpt_simple``.
"""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.lights import emission_in_pixel, emission_seen
from data_gen.paths.lobes import Lobes
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.walk import Limits, roulette
from data_gen.samplers.common import recorded
from data_gen.samplers.teaching.gpt_simple import base_step
from data_gen.scenes.load import reference_integrator


def make(scene: mi.Scene) -> SamplePass:
    """The sampler ``split``, with the parameters of the scene's own ``path``."""
    limits = Limits.of(reference_integrator(scene))
    lobes = Lobes(scene)
    return recorded(scene, partial(samples, scene, limits, lobes), lobes)


def samples(scene, limits: Limits, lobes: Lobes, camera: CameraSamples) -> dict:
    """Layers: one path, and a sample of features, for each camera sample."""
    ray, importance, _ = camera.rays()
    parts = trace(scene, limits, lobes, camera.random.clone(), ray, importance)
    diffuse, specular = (to_rgb(part, ray.wavelengths) for part in parts)
    direct = mi.Color3f(0)
    if limits.shows:
        seen = partial(emission_seen, scene, limits, None, active=mi.Bool(True))
        direct = to_rgb(emission_in_pixel(scene, camera, importance * seen(ray), seen), ray.wavelengths)
    layers = {"primal": direct + diffuse + specular, "direct": direct, "diffuse": diffuse, "specular": specular}
    return layers | features(scene, camera.sensor, camera.random.clone(), ray)


@dr.syntax
def trace(scene, limits: Limits, lobes: Lobes, random, ray, β) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Diffuse and specular light of paths that begin with ``ray``, of importance ``β``."""
    diffuse, specular = mi.Spectrum(0), mi.Spectrum(0)
    x = scene.ray_intersect(mi.Ray3f(ray))
    # The diffuse share of the light that comes to x from beyond, once that is settled
    share, settled = mi.Spectrum(0), mi.Bool(False)
    depth = mi.UInt32(1)
    active = x.is_valid() & (depth < limits.max_depth)
    while dr.hint(active, label="split"):
        step = base_step(scene, random, x, β, active)
        asked = active & ~settled

        # Emitter sampling
        light = β * step.L_light
        here = dr.select(settled, share, lobes.diffuse(x, x.to_local(step.light.d), asked))
        diffuse += here * light
        specular += (1 - here) * light

        # BSDF sampling: a Dirac delta is not diffuse, a hole settles nothing
        share = dr.select(settled, share, lobes.diffuse(x, step.wo, asked & step.smooth))
        settled |= ~step.hole
        light = step.β1 * step.L_bsdf
        diffuse += share * light
        specular += (1 - share) * light

        # Russian roulette
        q = roulette(dr.max(step.β1), depth >= limits.rr_depth)
        survives = random.next_1d() < q
        x, β = step.x1, step.β1 / q
        depth += 1
        active = survives & x.is_valid() & (depth < limits.max_depth)
    return diffuse, specular
