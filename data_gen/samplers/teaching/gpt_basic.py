r"""The teaching gradient-domain path tracer: Algorithm 1 of the survey, random sequence replay.

It is here to be read, and to check faster samplers. Each difference is between two complete path-traced samples, so
little can go wrong. But the paths share no work, so one sample costs as much as five paths.

    L               radiance of a path, a function of its random numbers u and its position on the film
    base, offset    the path through pixel p, and the path with the same u through a neighbour q of p
    Δ               L(u, q) - L(u, p): small, with low variance, where equal random numbers give similar paths

The density of u is the same for both paths, so the Jacobian of the shift and the densities cancel (survey, eq. 6-8).
The difference only needs two calls of Mitsuba's own estimator. Each difference is sampled in both directions, from p to
q and from q to p, with weight 1/2 each.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 2.3 and Algorithm 1]
"""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.lights import emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import GradientIntegrator, radiance, recorded
from data_gen.scenes.integrators import check_integrator, followed
from data_gen.scenes.load import reference_integrator


class GPTBasic(GradientIntegrator):
    """Gradient-domain path tracing by random sequence replay, around any Mitsuba integrator that samples radiance.

    Plugin ``gpt_basic``. Its only parameter is a nested integrator (default: ``path``), which determines the transport.
    It is not meant for production: after the first reflection that differs, base and offset path have nothing in
    common.
    """

    nested = True

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        nested = [value for _, value in props.items() if isinstance(value, mi.Integrator)]
        integrator = nested[0] if nested else mi.load_dict({"type": "path"})
        check_integrator(integrator)
        self.integrator = followed(integrator)

    @classmethod
    def parameters(cls, scene: mi.Scene) -> dict[str, Any]:
        return {"integrator": reference_integrator(scene)}

    def reference(self) -> mi.SamplingIntegrator:
        return self.integrator

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        estimate = radiance(scene, self.integrator)
        return recorded(scene, partial(self.samples, scene, estimate), shifts=SHIFTS.values())

    def samples(self, scene, estimate, camera: CameraSamples) -> dict:
        """One base path for each camera sample, shifted to the four neighbours of its pixel."""
        L, Le, _ = self.radiance(scene, estimate, camera, (0, 0))
        layers = {"primal": L + Le, "direct": Le}
        usable = dr.isfinite(dr.sum(L))
        for name, shift in SHIFTS.items():
            L_shifted, _, inside = self.radiance(scene, estimate, camera, shift)
            layers[name] = (L_shifted - L, inside & usable)
        ray, _, _ = camera.rays()
        return layers | features(scene, camera.sensor, camera.random.clone(), ray)

    def radiance(self, scene, estimate, camera: CameraSamples, shift) -> tuple[mi.Color3f, mi.Color3f, mi.Bool]:
        """L(u, p + shift) without directly seen emission, that emission, and whether p + shift is on the film.

        Directly seen emission is separate, because it has little noise, but its edges would be the strongest gradients
        of the image.
        """
        ray, importance, inside = camera.rays(shift)
        medium = camera.sensor.get_medium()
        # Each clone starts from the same state, so u is the same.
        L = estimate(camera.random.clone(), ray, medium, inside)
        Le = emission_seen(scene, self.integrator, medium, ray, inside)
        L, Le = to_rgb((L - Le) * importance, ray.wavelengths), to_rgb(Le * importance, ray.wavelengths)
        dr.eval(L, Le, inside)
        return L, Le, inside
