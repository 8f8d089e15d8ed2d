"""Crops made of nothing: smooth and hard-edged images with noise whose differences are less noisy, as rendered ones."""

import numpy as np

from ngpt.classical.gradients import forward_differences
from ngpt.stack import GradientStack


class SyntheticCrop:
    """What a dataset's crop offers, from a seed."""

    inputs = 2
    spp = (4, 32)
    paired = False

    def __init__(self, scene: str, seed: int, size: int = 32):
        rng = np.random.default_rng(seed)
        y, x = np.mgrid[:size, :size] / size
        image = 0.5 + 0.4 * np.sin(6 * rng.random() * x + 5 * rng.random() * y)[..., None] * rng.random(3)
        image[y + rng.random() * x > 0.8] *= rng.random(3) * 0.8 + 0.1
        self.scene, self.seed, self.size = scene, seed, size
        self.reference = image.astype(np.float32)
        self.reference_direct = np.zeros_like(self.reference)
        self.reference_caustic = np.zeros_like(self.reference)
        self.reference_halves = ()
        self.features = {
            "albedo": np.clip(self.reference, 0, 1),
            "normal": np.broadcast_to(np.float32([0, 0, 1]), image.shape),
            "depth": (1 + x[..., None]).astype(np.float32),
        }

    def stack(self, k: int) -> GradientStack:
        rng = np.random.default_rng((self.seed, k))
        noise = (self.reference / self.spp[k] ** 0.5).astype(np.float32)
        layers = {"primal": self.reference + noise * rng.standard_normal(noise.shape)}
        for name, difference in zip(("dx", "dy"), forward_differences(self.reference), strict=True):
            layers[name] = difference + 0.2 * noise * rng.standard_normal(noise.shape)
            layers[f"{name}_var"] = (0.2 * noise) ** 2
        layers["dx"][:, -1] = layers["dy"][-1] = 0
        return GradientStack.from_arrays(**layers, primal_var=noise**2, **self.features)
