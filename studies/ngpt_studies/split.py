"""A path tracer that splits light into two layers by the lobe of its first scattering event: diffuse and specular.

Kernel-predicting networks denoise the two separately [Bako et al. 2017, "Kernel-Predicting Convolutional Networks for
Denoising Monte Carlo Renderings", section 5.1]. If several lobes of the vertex scatter light to the camera, the layer
``diffuse`` gets the share f_diffuse / f of it (``Lobes``), for emitter and BSDF sampling alike. A split by the sampled
lobe would have the same mean, but more noise. All other light is specular: mirrors, glass, gloss, and emission seen
through holes. So primal = direct + diffuse + specular. Holes (null events) do not count as scattering events. Paths are
sampled as by Mitsuba's ``path``, with the steps of ``gpt_simple``.
"""

from __future__ import annotations

import re
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.lights import emission_in_pixel, emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import ByMaterial, materials_of
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
    """The layers of one path and one sample of the features, for each camera sample."""
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
    """The diffuse and the specular light of paths that begin with ``ray`` and the importance ``β``."""
    diffuse, specular = mi.Spectrum(0), mi.Spectrum(0)
    x = scene.ray_intersect(mi.Ray3f(ray))
    # The diffuse share of the light that reaches x; the first scattering event settles it.
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

        # BSDF sampling: a Dirac delta is not diffuse, and a hole does not settle the share
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


# The classes of materials that ignore ``BSDFContext.type_mask``: they always evaluate all of their lobes.
DEAF = ("Principled", "PrincipledThin")
# The keys in mi.traverse(), at any nesting, of their parameters that weigh diffuse lobes against all others
_NOT_DIFFUSE = re.compile(r"(?:^|(.*)\.)(metallic|spec_trans)(?:\.value|\.data)?$")
# In place of s, for materials that respect the mask
_HEARS = -1.0


class Lobes:
    """The share of diffuse lobes (``BSDFFlags.Diffuse``, reflection and transmission) in the light a material scatters.

    Most materials evaluate only the lobes in ``BSDFContext.type_mask``, and pass the mask on to nested materials.
    Principled materials ignore it. For these, and for materials that contain one, the diffuse part is approximated by
    Lambert's law, s ρ |cos θ| / π with s = (1 - metallic) (1 - spec_trans) and the reflectance
    ρ = ``eval_diffuse_reflectance()``; it is at most all the light that the material scatters. Textured parameters
    count with their mean. If a material contains several principled ones, s is the mean of theirs. Mitsuba does not
    list materials inside shape groups; all light that principled materials scatter there counts as diffuse.
    """

    def __init__(self, scene: mi.Scene):
        materials = materials_of(scene)
        table = np.full(max(materials, default=0) + 1, _HEARS, np.float32)
        for number, bsdf in materials.items():
            table[number] = _lambert(bsdf)
        self.lambert = ByMaterial(mi.Float(table))

    def diffuse(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """The diffuse share, in [0, 1] for each wavelength, of the light scattered from ``wo`` (local) to ``si.wi``.

        It is 0 where no light is scattered. ``wo`` may come from any technique, except from a Dirac delta, which is
        never diffuse.
        """
        bsdf = si.bsdf()
        flags = bsdf.flags()
        active = active & mi.has_flag(flags, mi.BSDFFlags.Diffuse)
        f = bsdf.eval(mi.BSDFContext(), si, wo, active)
        only = mi.BSDFContext()
        only.type_mask = int(mi.BSDFFlags.Diffuse)
        listed, s = self.lambert.of(bsdf, active)
        deaf = listed & (s != _HEARS)
        part = bsdf.eval(only, si, wo, active & ~deaf)
        reaches = (si.wi.z * wo.z > 0) | mi.has_flag(flags, mi.BSDFFlags.DiffuseTransmission)
        ρ = bsdf.eval_diffuse_reflectance(si, active & deaf & reaches)
        part = dr.select(deaf, dr.select(reaches, s * dr.abs(wo.z) / dr.pi, 0) * ρ, part)
        share = part / f
        # ``roughplastic`` is NaN below its horizon.
        return dr.select(active & (f > 0) & dr.isfinite(share), dr.clip(share, 0, 1), 0)


def _lambert(bsdf: mi.BSDF) -> float:
    """s of a material that ignores the mask, or contains one that does; ``_HEARS`` for all others."""
    params = mi.traverse(bsdf)
    if not any(getattr(node, "class_name", str)() in DEAF for node in params.hierarchy):
        return _HEARS
    shares: dict[str, float] = {}
    for key in params.keys():  # noqa: SIM118 - not a dict: iterating it yields pairs
        if match := _NOT_DIFFUSE.search(key):
            inside = match[1] or ""
            shares[inside] = shares.get(inside, 1.0) * (1 - float(np.mean(np.array(params[key]))))
    return float(np.clip(np.mean(list(shares.values())), 0, 1))
