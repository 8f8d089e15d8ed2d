"""A path tracer whose light is in two layers, by the lobe of its first scattering event: diffuse and specular.

Kernel-predicting networks denoise the two apart [Bako et al. 2017, "Kernel-Predicting Convolutional Networks for
Denoising Monte Carlo Renderings", section 5.1]. Light that reaches the camera in several lobes of one vertex is shared
between the layers in proportion to them, f_diffuse / f (``Lobes``), by whichever technique it was found: that has less
noise than to go by the lobe which was sampled, and the same mean. The rest, mirrors, glass, gloss, and emission seen
through holes, is specular, and primal = direct + diffuse + specular. Holes (null events) are no scattering. Paths are
sampled as by Mitsuba's ``path``, steps taken as in ``gpt_simple``.
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


# Materials that evaluate all of their lobes whatever ``BSDFContext.type_mask`` says, by the names of their classes.
DEAF = ("Principled", "PrincipledThin")
# Their parameters that weigh diffuse lobes against all others, as mi.traverse() spells them, at any nesting.
_NOT_DIFFUSE = re.compile(r"(?:^|(.*)\.)(metallic|spec_trans)(?:\.value|\.data)?$")
# Stands for: this material hears the mask.
_HEARS = -1.0


class Lobes:
    """The share of diffuse lobes (``BSDFFlags.Diffuse``, reflection and transmission) in what a material scatters.

    Materials evaluate only some of their lobes if ``BSDFContext.type_mask`` asks for it, and hand the mask on to those
    inside. Principled materials ignore it. For these, and for materials that hold one, the diffuse part is approximated
    by Lambert's law, s ρ |cos θ| / π with s = (1 - metallic) (1 - spec_trans) and the reflectance
    ρ = ``eval_diffuse_reflectance()``; it is clamped to all that the material scatters. Textured parameters count with
    their mean, and several such materials in one with the mean of their s. Mitsuba does not list materials inside shape
    groups: all that principled materials scatter there counts as diffuse.
    """

    def __init__(self, scene: mi.Scene):
        materials = materials_of(scene)
        table = np.full(max(materials, default=0) + 1, _HEARS, np.float32)
        for number, bsdf in materials.items():
            table[number] = _lambert(bsdf)
        self.lambert = ByMaterial(mi.Float(table))

    def diffuse(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """The share, in [0, 1] for each wavelength, in the light that goes from ``wo`` (local) into ``si.wi``.

        It is 0 where there is no such light. It holds for directions that were sampled or chosen otherwise, but not for
        Dirac deltas, which are never diffuse.
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
        # ``roughplastic`` says NaN below its horizon.
        return dr.select(active & (f > 0) & dr.isfinite(share), dr.clip(share, 0, 1), 0)


def _lambert(bsdf: mi.BSDF) -> float:
    """s of a material that is, or holds, one that does not hear the mask; ``_HEARS`` of all others."""
    params = mi.traverse(bsdf)
    if not any(getattr(node, "class_name", str)() in DEAF for node in params.hierarchy):
        return _HEARS
    shares: dict[str, float] = {}
    for key in params.keys():  # noqa: SIM118 - not a dict: iterating it yields pairs
        if match := _NOT_DIFFUSE.search(key):
            inside = match[1] or ""
            shares[inside] = shares.get(inside, 1.0) * (1 - float(np.mean(np.array(params[key]))))
    return float(np.clip(np.mean(list(shares.values())), 0, 1))
