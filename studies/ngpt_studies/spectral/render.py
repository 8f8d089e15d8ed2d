"""Images by bins of wavelengths, and differences between neighbouring bins.

A base path has one wavelength. Its offset path has the same random numbers and a wavelength one bin further. So the two
differ where glass disperses, and in the colours of materials. Their difference is an unbiased estimate of the
difference between the two bins, since the replay of random numbers has no Jacobian. As with ``gpt-basic``, this works
for any integrator of Mitsuba that chooses no wavelengths itself. [Petitjean, Bauszat and Eisemann 2018, "Spectral
gradient sampling for path tracing", which copies half vectors instead; survey, section 7.3]
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

# The range of wavelengths in nm; beyond it, the eye sees next to nothing.
LOW, HIGH = 380.0, 730.0
# The number of lanes of a pass
_LANES = 1 << 20


@dataclass(frozen=True)
class Spectra:
    """Means over samples and the variances of these means, (H, W, bins) float64.

    ``light`` is the light of each bin. ``step`` is the light of the next bin minus that, 0 for the last bin, or None if
    it was not sampled.
    """

    light: np.ndarray
    light_var: np.ndarray
    step: np.ndarray | None
    step_var: np.ndarray | None

    @property
    def edges(self) -> np.ndarray:
        """The limits of the bins in nm, (bins + 1)."""
        return np.linspace(LOW, HIGH, self.light.shape[-1] + 1)


def render_spectra(scene: mi.Scene, bins: int, samples: int, seed: int = 0, steps: bool = True) -> Spectra:
    """Renders ``samples`` base paths for each bin of each pixel, and with ``steps`` an offset path for each of them.

    Radiance is that of the scene's own integrator, in its spectral units. Raises NgptError for a variant that is
    polarised or not spectral, and for less than 2 bins or samples.
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
            # Lanes are in the order of pixels, and within a pixel in the order of samples. Bins take turns.
            lanes = np.array(value, np.float64).reshape(height, width, -1, bins)
            sums[name] += np.stack([lanes.sum(axis=2), np.square(lanes).sum(axis=2)])
    means = {name: total[0] / samples for name, total in sums.items()}
    spread = {name: np.maximum(total[1] / samples - means[name] ** 2, 0) for name, total in sums.items()}
    variances = {name: value / (samples - 1) for name, value in spread.items()}
    return Spectra(means["light"], variances["light"], means.get("step"), variances.get("step"))


def _sampled(estimate, camera: CameraSamples, bins: int, count: int, steps: bool) -> list[mi.Float]:
    """The light of the base paths of a pass and, with ``steps``, the light of their offset paths minus that."""
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
        # The last bin has no step.
        values.append(dr.select(bin_ + 1 < n, light(wavelength + width, bin_ + 1 < n) - values[0], 0))
    dr.eval(values)
    return values


# The side, in pixels, of the square over which variances are averaged, since they are as noisy as the light.
REACH = 5


def reconstructed(spectra: Spectra) -> np.ndarray:
    """The image I (H, W, bins) that minimises Σ |I - light|² / v + Σ |I_b+1 - I_b - step|² / s, exactly.

    v and s are the variances of light and steps, averaged over all bins and over ``REACH`` x ``REACH`` pixels, so each
    pixel has one v and one s. Steps do not change the sum over bins.
    """
    if spectra.step is None or spectra.step_var is None:
        return spectra.light
    both = spectra.light_var, spectra.step_var[..., :-1]
    v, s = (uniform_filter(variance.mean(axis=-1), REACH) for variance in both)
    weight = (v / np.maximum(s, 1e-12 * v + 1e-300))[..., None]
    bins = spectra.light.shape[-1]
    # The matrix of the steps has the same eigenvectors for all pixels: cosines.
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
    """Linear RGB (H, W, 3) of spectra (H, W, bins) that are constant within each bin; ``edges`` are in nm."""
    fine = 16
    steps = (np.arange(fine) + 0.5) / fine
    wavelengths = (edges[:-1, None] + steps * np.diff(edges)[:, None]).ravel()
    # A film's pixel is the mean of light divided by the density of its wavelength, which is 1 / (HIGH - LOW) here.
    light = mi.Float(np.full(wavelengths.size, edges[-1] - edges[0], np.float32))
    colours = np.array(mi.spectrum_to_srgb(mi.Spectrum(light), mi.Spectrum(mi.Float(wavelengths.astype(np.float32)))))
    return values @ colours.T.reshape(-1, fine, 3).mean(axis=1) / len(values[0, 0])
