"""What share of the light that a material scatters comes from its diffuse lobes."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.vertex import ByMaterial, materials_of

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
