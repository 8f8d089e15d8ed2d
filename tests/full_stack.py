"""Stacks with all layers that networks read, of any size and brightness, made without a renderer."""

from unittest.mock import patch

import numpy as np

from ngpt.classical.gradients import forward_differences
from ngpt.stack import GradientStack


def full_layers(height, width, scale=1.0, seed=0):
    """Layers (H, W, C) float32 of a noisy image with gradients, features and variances."""
    rng = np.random.default_rng(seed)
    image = np.cumsum(rng.random((height, width, 3)), axis=1) / 8 + 0.1
    dx, dy = forward_differences(image)
    layers = {"primal": image * rng.gamma(4, 0.25, image.shape), "dx": dx + 0.05 * rng.normal(size=dx.shape), "dy": dy}
    layers |= {"primal_var": image**2 / 4, "dx_var": 0.0025 + 0 * dx, "dy_var": rng.random(dy.shape) / 100}
    layers["dx"][:, -1] = layers["dy"][-1] = 0
    powers = {"primal": 1, "dx": 1, "dy": 1, "primal_var": 2, "dx_var": 2, "dy_var": 2}
    layers = {name: layer * scale ** powers[name] for name, layer in layers.items()}
    layers["albedo"], layers["depth"] = rng.random(image.shape), 5 * rng.random((height, width, 1))
    layers["normal"] = rng.normal(size=image.shape)
    layers["normal"] /= np.linalg.norm(layers["normal"], axis=-1, keepdims=True)
    return {name: layer.astype(np.float32) for name, layer in layers.items()}


def full_stack(height, width, scale=1.0, seed=0):
    return GradientStack.from_arrays(**full_layers(height, width, scale, seed))


def hidden_oidn():
    """As if OIDN were not installed."""
    return patch("ngpt.denoisers.oidn.find_spec", lambda name: None)
