"""How far photons are gathered from: in pixels at first, and less and less.

Pass i gathers within r_i, with r_(i+1)^d = r_i^d (i + α) / (i + 1); d is 2 on surfaces and 3 in media, the dimension of
what photons are counted in. So r^d falls like i^(α - 1): slowly enough that the noise of the mean over passes goes to
zero like i^-α, and its bias like r², i^(2 (α - 1) / d). Every pass is on its own, no point keeps statistics (Knaus and
Zwicker 2011, "Progressive Photon Mapping: A Probabilistic Approach", eq. 15 and 24).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features

ALPHA = 2 / 3


def shrunk(i: int, dimension: int = 2) -> float:
    """r_i / r_0, i from 0, where photons are counted in a disk, or in a ball (``dimension`` 3)."""
    # The product of (k + α) / (k + 1) over k = 1 .. i, by the Gamma function
    log_ratio = math.lgamma(i + 1 + ALPHA) - math.lgamma(1 + ALPHA) - math.lgamma(i + 2)
    return math.exp(log_ratio / dimension)


def pixel_width(scene: mi.Scene, sensor: mi.Sensor) -> float:
    """How wide a pixel of ``sensor`` is where that sees something, in world units: the median over the image.

    Where it sees nothing, or knows of no rays side by side, a thousandth of the scene's diagonal.
    """
    camera = CameraSamples(sensor, 0, 1)
    ray, _, _ = camera.rays()
    depth = features(scene, camera.sensor, camera.random.clone(), ray)["depth"]
    # With a perspective camera Mitsuba 3.9 begins the neighbour's ray where this one begins, on the near plane.
    fans = dr.squared_norm(ray.d_x - ray.d) > 0
    aside = dr.select(fans, dr.norm(ray.d_x - ray.d) * depth, dr.norm(ray.o_x - ray.o))
    dr.eval(depth, aside)
    seen = (np.array(depth) > 0) & ray.has_differentials
    box = scene.bbox()
    wide = np.median(np.array(aside)[seen]) if seen.any() else 1e-3 * np.linalg.norm(np.array(box.extents()))
    return float(wide)
