"""Differences in time: the same random numbers in the scene of this frame and in the scene of the previous frame.

A camera sample at x in this frame has a partner at x + m in the previous frame, with the pixel's motion m. From there
on, both paths use the same random numbers: where nothing but the motion has changed, both find the same light. The mean
of the difference over a pixel p is I_t(p) - I_{t-1}(p + m), where p + m is a pixel between the pixels of the film,
box-filtered like them; no values are interpolated.

[Random sequence replay between frames: Manzi et al. 2016, "Temporal gradient-domain path tracing", section 4]
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import block_of_samples, recording
from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import radiance
from data_gen.scenes.load import reference_integrator

# The number of batches is large enough to estimate the variance. Each batch keeps a mean for every pixel.
BATCHES = 16


def light(scene: mi.Scene, seed: int, spp: int, motion: np.ndarray | None = None) -> list[tuple[int, np.ndarray]]:
    """All light except directly seen emission, in batches: (samples per pixel, their mean (H, W, 3)).

    With the ``motion`` (H, W, 2) of a later frame, samples are partners of the samples with the same ``seed`` there.
    A mean is NaN where a partner is not on the film, the motion is not known, or a sample is not finite.
    """
    integrator, sensor = reference_integrator(scene), scene.sensors()[0]
    estimate, medium = radiance(scene, integrator), sensor.get_medium()
    width, height = (int(n) for n in sensor.film().crop_size())
    each = min(-(-spp // BATCHES), block_of_samples(width * height))
    found = []
    for first in range(0, spp, each):
        count = min(each, spp - first)
        with recording():
            camera = CameraSamples(sensor, seed, count, first)
            ray, importance, active = camera.rays((0, 0) if motion is None else _partners(camera, motion))
            L = estimate(camera.random.clone(), ray, medium, active)
            L -= emission_seen(scene, integrator, medium, ray, active)
            rgb = to_rgb(L * importance, ray.wavelengths)
            rgb = dr.select(active & dr.all(dr.isfinite(rgb)), rgb, dr.nan)
            dr.eval(rgb)
        found.append((count, np.array(rgb).T.reshape(height, width, count, 3).mean(axis=2)))
    return found


def _partners(camera: CameraSamples, motion: np.ndarray) -> mi.Vector2f:
    """The motion of each sample's pixel. Where the motion is not known, a motion that leads off the film is
    returned."""
    pixels = np.where(np.isfinite(motion).all(axis=-1, keepdims=True), motion, -1e6).reshape(-1, 2)
    return mi.Vector2f(*(dr.gather(mi.Float, mi.Float(pixels[:, axis]), camera.pixel) for axis in (0, 1)))


def difference(
    now: list[tuple[int, np.ndarray]], before: list[tuple[int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """dt and dt_var, (H, W, 3) float32, of the batches of ``light`` in both frames. With one batch, dt_var is NaN."""
    weights = [count for count, _ in now]
    total = sum(weights)
    batches = [(here - there).astype(np.float64) for (_, here), (_, there) in zip(now, before, strict=True)]
    mean = sum(n * batch for n, batch in zip(weights, batches, strict=True)) / total
    # The mean of a batch of n samples has 1/n of the variance of a sample.
    squares = sum(n * np.square(batch - mean) for n, batch in zip(weights, batches, strict=True))
    variance = squares / (total * (len(batches) - 1)) if len(batches) > 1 else np.full_like(mean, np.nan)
    return mean.astype(np.float32), variance.astype(np.float32)
