"""Clear glass whose index of refraction depends on the wavelength: Mitsuba's ``dielectric`` has one for all."""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from ngpt.errors import NgptError

# Sellmeier's coefficients B and C (µm²), as the makers of the glasses have them.
SELLMEIER = {
    "n-bk7": ((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "n-sf11": ((1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629)),
}
# The wavelength of sodium light, in nm: what a single index stands for
SODIUM = 589.3


def index(material: str, wavelength):
    """n(λ), λ in nm: n² = 1 + Σ B λ² / (λ² - C), λ in µm; of a number, a NumPy array or a Float."""
    square = (wavelength * 1e-3) ** 2
    total = 1 + sum(b * square / (square - c) for b, c in zip(*SELLMEIER[material], strict=True))
    return dr.sqrt(total) if dr.is_jit_v(total) else total**0.5


def register() -> None:
    """Makes ``dispersive`` a material of the current variant."""
    mi.register_bsdf("dispersive", _glass_class(mi.variant()))


@cache
def _glass_class(variant: str) -> type:
    """The material's class; Mitsuba's own classes, and so those derived from them, belong to a variant."""

    class Dispersive(mi.BSDF):
        """A smooth dielectric in vacuum. ``material``: a name of ``SELLMEIER`` ("n-bk7").

        A ray goes the way of its first wavelength. So images are right where all wavelengths of a ray are one, as
        ``data_gen.samplers.studies.spectral.render`` has them; elsewhere the others lose their way, but no light. In
        variants without wavelengths the index is for sodium light.
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
            # Radiance is compressed where it goes in.
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
