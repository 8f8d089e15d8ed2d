"""Measures whether albedo and normals of a scene help OIDN more than they cost."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

_PIXELS = 1 << 12
# Features (albedo and normals) do not pay if their noise exceeds this share of their variance. Outdoors, rendering
# features takes 50 to 100 % of the time of the rest of a sample. In a product shot whose features had a noise of .03,
# the error with features was 1.1 times the error without them, after 1.1 times the seconds
# (docs/start/which-sampler.md).
_NOISE = 0.01


def features_pay(scene: mi.Scene) -> bool:
    """Whether albedo and normals pay. If the lens blurs them, they are as noisy as the image and do not pay."""
    return scene.sensors()[0].class_name() != "ThinLensCamera" or noise_of_features(scene) < _NOISE


def noise_of_features(scene: mi.Scene) -> float:
    """The noise of albedo and normal, as a share of their variance over the image.

    The noise is half of the mean squared difference between the features that two points of the lens see. It is
    measured with single samples at the first surface. The random numbers are always the same.
    """
    random = mi.PCG32(_PIXELS)
    place, *lens = (mi.Point2f(random.next_float32(), random.next_float32()) for _ in range(3))
    sensor, found = scene.sensors()[0], []
    for point in lens:
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, place, point)
        si = scene.ray_intersect(ray)
        albedo = si.bsdf().eval_diffuse_reflectance(si, si.is_valid())
        layers = (mi.Color3f(albedo), mi.Color3f(si.sh_frame.n))
        found.append(np.concatenate([np.array(dr.select(si.is_valid(), layer, 0)) for layer in layers]))
    one, other = found
    noise, variance = np.square(one - other).mean() / 2, one.var(axis=1).mean()
    return float(noise / max(variance, 1e-12))
