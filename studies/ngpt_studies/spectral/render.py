"""Images by bins of wavelengths, and differences between neighbouring bins.

A base path has one wavelength. Its offset path has the same random numbers and the wavelength one bin further, so both
differ where glass disperses, and in colours. Their difference estimates the difference of the two bins, without bias:
the replay of random numbers has no Jacobian. As in ``gpt-basic``, for any integrator of Mitsuba that knows no
wavelengths of its own. [Petitjean, Bauszat and Eisemann 2018, "Spectral gradient sampling for path tracing"; survey,
section 7.3. They copy half vectors instead.]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from data_gen.samplers.common import radiance
from data_gen.scenes.load import reference_integrator
from ngpt.errors import NgptError

# nm; there is next to no colour beyond.
LOW, HIGH = 380.0, 730.0
# Lanes of a pass
_LANES = 1 << 20


@dataclass(frozen=True)
class Spectra:
    """Means over samples, and variances of these, (H, W, bins) float64: of the light of each bin, and of its step:
    what the next bin has more. The last step is 0; None if none was sampled."""

    light: np.ndarray
    light_var: np.ndarray
    step: np.ndarray | None
    step_var: np.ndarray | None

    @property
    def edges(self) -> np.ndarray:
        """Wavelengths between which the bins are, in nm."""
        return np.linspace(LOW, HIGH, self.light.shape[-1] + 1)


def render_spectra(scene: mi.Scene, bins: int, samples: int, seed: int = 0, steps: bool = True) -> Spectra:
    """``samples`` base paths for each bin of each pixel, at least 2; with ``steps`` an offset path each.

    Radiance is from the scene's own integrator, in its spectral units. Raises NgptError without a spectral variant.
    """
    if not mi.is_spectral or mi.is_polarized:
        raise NgptError(f"variant '{mi.variant()}' has no spectra to render; use 'llvm_ad_spectral'")
    if bins < 2 or samples < 2:
        raise NgptError(f"{bins} bins and {samples} samples: at least 2 of each are needed")
    sensor = scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    each = bins * max(1, min(samples, _LANES // (width * height * bins)))
    estimate = radiance(scene, reference_integrator(scene))
    names = ("light", "step") if steps else ("light",)
    sums = {name: np.zeros((2, height, width, bins)) for name in names}
    for first in range(0, bins * samples, each):
        count = min(each, bins * samples - first)
        with recording():
            camera = CameraSamples(sensor, seed, count, first)
            values = _sampled(estimate, camera, bins, count, steps)
        for name, value in zip(names, values, strict=False):
            # Lanes go pixel by pixel, and within a pixel by sample, whose number says the bin.
            lanes = np.array(value, np.float64).reshape(height, width, -1, bins)
            sums[name] += np.stack([lanes.sum(axis=2), np.square(lanes).sum(axis=2)])
    means = {name: total[0] / samples for name, total in sums.items()}
    spread = {name: np.maximum(total[1] / samples - means[name] ** 2, 0) for name, total in sums.items()}
    variances = {name: value / (samples - 1) for name, value in spread.items()}
    return Spectra(means["light"], variances["light"], means.get("step"), variances.get("step"))


def _sampled(estimate, camera: CameraSamples, bins: int, count: int, steps: bool) -> list[mi.Float]:
    """Light of the paths of a pass, and what those one bin further have more."""
    n, width = dr.opaque(mi.UInt32, bins), dr.opaque(mi.Float, (HIGH - LOW) / bins)
    bin_ = dr.arange(mi.UInt32, camera.pixels * count) % n

    def light(wavelength: mi.Float, active: mi.Bool) -> mi.Float:
        ray, _, _ = camera.rays()
        ray.wavelengths = type(ray.wavelengths)(wavelength)
        L = estimate(camera.random.clone(), ray, camera.sensor.get_medium(), active)[0]
        return dr.select(active & dr.isfinite(L), L, 0)

    wavelength = LOW + (bin_ + camera.wavelength) * width
    values = [light(wavelength, mi.Bool(True))]
    if steps:
        # Beyond the last bin there is none.
        values.append(dr.select(bin_ + 1 < n, light(wavelength + width, bin_ + 1 < n) - values[0], 0))
    dr.eval(values)
    return values


# Pixels over which variances are averaged: they are as noisy as the light.
REACH = 5


def reconstructed(spectra: Spectra) -> np.ndarray:
    """The (H, W, bins) that minimises Σ |I - light|² / v + Σ |I_b+1 - I_b - step|² / s, exactly.

    v and s are the variances of light and steps, averaged over bins and ``REACH`` pixels, so both are one number for a
    pixel. The sum over bins equals the light's sum: steps do not determine it.
    """
    if spectra.step is None or spectra.step_var is None:
        return spectra.light
    both = spectra.light_var, spectra.step_var[..., :-1]
    v, s = (uniform_filter(variance.mean(axis=-1), REACH) for variance in both)
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
