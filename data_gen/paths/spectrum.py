"""Converts radiance from the colours of any Mitsuba variant to scene-linear RGB."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def to_rgb(value: mi.Spectrum, wavelengths: mi.Wavelength) -> mi.Color3f:
    """Linear RGB (Rec. 709 primaries) of a spectrum sample, for RGB, monochrome and spectral variants.

    Polarised variants carry Mueller matrices; only the intensity is kept.
    """
    if mi.is_polarized:
        value = mi.unpolarized_spectrum(value)
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    if mi.is_monochromatic:
        return mi.Color3f(value[0])
    return mi.Color3f(value)


def reflectance_to_rgb(value: mi.Spectrum, wavelengths: mi.Wavelength) -> mi.Color3f:
    """Linear RGB of a reflectance, in [0, 1]: white is (1, 1, 1), whatever light the variant assumes."""
    rgb = to_rgb(value, wavelengths)
    if mi.is_spectral:
        rgb = rgb / to_rgb(mi.Spectrum(1), wavelengths)
    return mi.Color3f(*(dr.fmin(dr.fmax(c, 0), 1) for c in rgb))
