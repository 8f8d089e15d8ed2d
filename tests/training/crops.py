"""Crops made of nothing, and small runs on them: for tests of training, and for programs that they start."""

import json

import numpy as np
import torch

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.stack import GradientStack
from ngpt.training.images import Images
from ngpt.training.settings import from_dict
from ngpt.training.trainer import Trainer


class SyntheticCrop:
    """What a dataset's crop offers, from a seed: smooth and hard-edged, with differences less noisy than the image."""

    inputs = 2
    spp = (4, 32)
    paired = False
    reference_halves = ()

    def __init__(self, scene: str, seed: int, size: int = 32):
        rng = np.random.default_rng(seed)
        y, x = np.mgrid[:size, :size] / size
        image = 0.5 + 0.4 * np.sin(6 * rng.random() * x + 5 * rng.random() * y)[..., None] * rng.random(3)
        image[y + rng.random() * x > 0.8] *= rng.random(3) * 0.8 + 0.1
        self.scene, self.seed, self.size = scene, seed, size
        self.reference = image.astype(np.float32)
        self.reference_direct = np.zeros_like(self.reference)
        self.reference_caustic = np.zeros_like(self.reference)
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


class PairedCrop:
    """Two renders of one view, of equally many samples, and nothing else."""

    inputs, paired = 2, True

    def __init__(self, scene: str, seed: int, spp: float = 16):
        self.scene, self.spp, self.of = scene, (spp, spp), SyntheticCrop(scene, seed)
        self.of.spp = self.spp

    def stack(self, k):
        return self.of.stack(k)


CROPS = [SyntheticCrop(f"scene{i}", i) for i in range(6)]
SETTINGS = {
    "model": {
        "network": "dense",
        "channels": [4, 6],
        "units": [1, 1],
        "inputs": ["primal", "dx", "dy", "albedo", "normal", "depth"],
    },
    "data": {"crop": 32},
    "augmentation": {"brightness": 0.0},
    "optimizer": {"learning_rate": 1e-2, "schedule": "cosine", "warmup": 5, "ema": 0.9},
    "run": {"steps": 12, "batch": 2, "log": 2, "save": 5, "validate": 6},
}


def loss(prediction, target, generator):
    """Random, so that resuming must restore the generator too."""
    weight = 1 + 0.1 * torch.rand(target.shape, generator=generator)
    parts = {"l1": (weight * (prediction - target).abs()).mean()}
    return parts["l1"], parts


def settings(**changes):
    """``SETTINGS`` with ``table_key`` changed; a key without a table stands by itself."""
    values = json.loads(json.dumps(SETTINGS))
    for name, value in changes.items():
        table, _, key = name.partition("_")
        if key:
            values.setdefault(table, {})[key] = value
        else:
            values[table] = value
    return from_dict(values, "test")


def trainer(out, crops=CROPS[:4], held_out=CROPS[4:], loss=loss, **changes):
    out.mkdir(exist_ok=True)
    chosen = settings(**changes)
    return Trainer(chosen, Images(chosen, crops, held_out, loss), out, say=lambda text: None)


def view(folder, seed=0):
    """A folder of one's own with a view: a stack and its reference; the crop that they are of."""
    crop = SyntheticCrop("", seed)
    folder.mkdir(parents=True)
    ngpt.write(folder / "reference.exr", crop.reference)
    ngpt.write(folder / "few.exr", crop.stack(0))
    return crop
