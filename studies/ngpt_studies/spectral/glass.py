"""Clear glass whose index of refraction depends on the wavelength, unlike that of Mitsuba's ``dielectric``.

Also a scene with such glass: a prism and a ball before stripes.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ngpt.errors import NgptError

# Sellmeier's coefficients B and C (µm²), from the makers of the glasses
SELLMEIER = {
    "n-bk7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "n-sf11": ((1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629)),
}
# The wavelength of sodium light in nm: a single index of refraction is given for it.
SODIUM = 589.3


def index(material: str, wavelength):
    """The index of refraction at a ``wavelength`` in nm: a number, a NumPy array or a Float.

    n² = 1 + Σ B λ² / (λ² - C), with λ in µm.
    """
    square = (wavelength * 1e-3) ** 2
    total = 1 + sum(b * square / (square - c) for b, c in zip(*SELLMEIER[material], strict=True))
    return dr.sqrt(total) if dr.is_jit_v(total) else total**0.5


def register() -> None:
    """Makes ``dispersive`` a material of the current variant."""
    mi.register_bsdf("dispersive", _glass_class(mi.variant()))


@cache
def _glass_class(variant: str) -> type:
    """The material's class for a variant: each variant has its own ``mi.BSDF``."""

    class Dispersive(mi.BSDF):
        """A smooth dielectric in vacuum. ``material``: a name of ``SELLMEIER`` ("n-bk7").

        A ray is refracted by the index at its first wavelength. So images are correct if all wavelengths of a ray are
        equal, as in ``ngpt_studies.spectral.render``. Otherwise, the light of the other wavelengths takes a wrong
        direction, but none is lost. In variants without wavelengths, the index is that for sodium light.
        """

        def __init__(self, props):
            super().__init__(props)
            self.material = props.get("material", "n-bk7")
            if self.material not in SELLMEIER:
                names = ", ".join(SELLMEIER)
                raise NgptError(f"dispersive: unknown material '{self.material}'; choose one of: {names}")
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            reflection = mi.BSDFFlags.DeltaReflection | sides
            transmission = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric | sides
            self.m_components = [reflection, transmission]
            self.m_flags = reflection | transmission

        def sample(self, ctx, si, sample1, sample2, active=True):
            n = index(self.material, si.wavelengths[0] if mi.is_spectral else mi.Float(SODIUM))
            r, cos_theta_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), n)
            reflected = sample1 <= r
            bs = dr.zeros(mi.BSDFSample3f)
            bs.pdf = dr.select(reflected, r, 1 - r)
            bs.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
            kinds = (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
            bs.sampled_type = dr.select(reflected, *(mi.UInt32(int(kind)) for kind in kinds))
            bs.wo = dr.select(reflected, mi.reflect(si.wi), mi.refract(si.wi, cos_theta_t, eta_ti))
            bs.eta = dr.select(reflected, 1, eta_it)
            # Refraction scales radiance by the square of the relative index.
            radiance = ctx.mode == mi.TransportMode.Radiance
            weight = dr.select(reflected | (not radiance), mi.Float(1), dr.square(eta_ti))
            return bs, mi.Spectrum(weight) & active

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(0)

        def pdf(self, ctx, si, wo, active=True):
            return mi.Float(0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return mi.Spectrum(0), mi.Float(0)

        def to_string(self):
            return f"Dispersive[material={self.material}]"

    return Dispersive


def prism(material: str = "n-sf11") -> dict:
    """A prism with angles of 60°, and a ball, before a wall of dark and bright stripes, under one lamp, in metres."""
    grey, glass = _diffuse(0.5), {"type": "dispersive", "material": material}
    stripes = {"type": "checkerboard", "color0": _rgb(0.05), "color1": _rgb(0.8)}
    stripes["to_uv"] = mi.ScalarTransform4f().scale([12, 1, 1])
    # Turns the cube, whose corners are at -1 and 1, into a prism over a rhombus with angles of 60° and 120°.
    rhombus = np.eye(4)
    rhombus[:3, 0], rhombus[:3, 1] = (0.3, 0, 0.3 * 3**0.5), (0.3, 0, -0.3 * 3**0.5)
    rhombus[:3, 2], rhombus[:3, 3] = (0, 0.7, 0), (-0.75, 0.75, 0.2)
    look_at = mi.ScalarTransform4f().look_at
    wide = mi.ScalarTransform4f().scale([3, 3, 1])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 10},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": look_at(origin=[0, 0.9, 4.2], target=[0, 0.75, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 96, "height": 64, "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]) @ wide,
            "bsdf": grey,
        },
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 1, -2]) @ wide,
            "bsdf": {"type": "diffuse", "reflectance": stripes},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": look_at(origin=[1.5, 3, 2], target=[0, 0.5, -1], up=[0, 1, 0]),
            "emitter": {"type": "area", "radiance": {"type": "d65", "scale": 6.0}},
        },
        "prism": {"type": "cube", "to_world": mi.ScalarTransform4f(rhombus), "bsdf": glass},
        "ball": {"type": "sphere", "center": [0.85, 0.6, 0.4], "radius": 0.6, "bsdf": glass},
    }


def _rgb(value: float) -> dict:
    return {"type": "rgb", "value": [value] * 3}


def _diffuse(value: float) -> dict:
    return {"type": "diffuse", "reflectance": _rgb(value)}
