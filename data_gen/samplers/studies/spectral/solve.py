"""Spectra of pixels from the light of bins and its steps: the screened Poisson equation in one dimension, and RGB."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from data_gen.samplers.studies.spectral.render import Spectra

# Pixels over which variances are averaged: they are as noisy as the light.
REACH = 5


def reconstructed(spectra: Spectra) -> np.ndarray:
    """The (H, W, bins) that minimises Σ |I - light|² / v + Σ |I_b+1 - I_b - step|² / s, exactly.

    v and s are the variances of light and steps, averaged over bins and ``REACH`` pixels, so both are one number for a
    pixel. The sum over bins equals the light's sum: steps do not determine it.
    """
    if spectra.step is None or spectra.step_var is None:
        return spectra.light
    v, s = (
        uniform_filter(variance.mean(axis=-1), REACH) for variance in (spectra.light_var, spectra.step_var[..., :-1])
    )
    weight = (v / np.maximum(s, 1e-12 * v + 1e-300))[..., None]
    bins = spectra.light.shape[-1]
    # Steps that there are, between bins: for all pixels the same eigenvectors, the cosines
    rows = np.arange(bins)
    basis = np.cos(np.pi * (rows[:, None] + 0.5) * rows / bins) * np.sqrt(2 / bins)
    basis[:, 0] = np.sqrt(1 / bins)
    eigenvalues = 4 * np.sin(np.pi * rows / 2 / bins) ** 2
    flux = spectra.step.copy()
    flux[..., -1] = 0
    divergence = -flux
    divergence[..., 1:] += flux[..., :-1]
    right = (spectra.light + weight * divergence) @ basis
    return (right / (1 + weight * eigenvalues)) @ basis.T


def to_rgb(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Linear RGB, (H, W, 3), of spectra (H, W, bins) that are constant between the ``edges`` in nm."""
    fine = 16
    steps = (np.arange(fine) + 0.5) / fine
    wavelengths = (edges[:-1, None] + steps * np.diff(edges)[:, None]).ravel()
    # A pixel of a film has the mean of light over density, which is 1 / (HIGH - LOW) here.
    light = mi.Float(np.full(wavelengths.size, edges[-1] - edges[0], np.float32))
    colours = np.array(mi.spectrum_to_srgb(mi.Spectrum(light), mi.Spectrum(mi.Float(wavelengths.astype(np.float32)))))
    return values @ colours.T.reshape(-1, fine, 3).mean(axis=1) / len(values[0, 0])
