"""Small runs of training, for tests and for programs that they start."""

import json

import torch
from crops import SyntheticCrop

from ngpt.training.settings import from_dict
from ngpt.training.trainer import Trainer

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
    values = json.loads(json.dumps(SETTINGS))
    for name, value in changes.items():
        table, _, key = name.partition("_")
        values[table][key] = value
    return from_dict(values, "test")


def trainer(out, crops=CROPS, **changes):
    out.mkdir(exist_ok=True)
    return Trainer(settings(**changes), crops[:4], crops[4:], loss, out, say=lambda text: None)
