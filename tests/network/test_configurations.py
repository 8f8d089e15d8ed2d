"""Configurations of networks that cannot be: each says what is wrong with which value."""

import pytest
from networks import PYRAMID, SLOPES

from ngpt.errors import NgptError
from ngpt.network.model import ModelConfig
from ngpt.network.oidnet import SHAPES
from ngpt.training.augment import Augmentation

DENSE = {"network": "dense", "channels": (4,), "units": (1,), "inputs": ("primal",)}
PLAIN = {"network": "plain", "channels": (4,), "units": (), "inputs": ("primal",)}
OF_KERNELS = PLAIN | {"channels": (6, 6, 6), "inputs": ("primal", "albedo")} | PYRAMID
DRAWN = PLAIN | {"channels": (4, 4, 4, 4), "inputs": SLOPES, "base": "wcv", "sweeps": 2}
QUIET = PLAIN | {"inputs": ("primal", "base", "primal_se"), "base": "wcv"}
OIDN = {"network": "oidn", "channels": next(iter(SHAPES)), "units": (), "inputs": ("base", "albedo", "normal")}
OIDN |= {"base": "wcv"}
ROWS = [
    (DENSE, {"network": "round"}, "unknown network 'round'; choose one of: dense, plain, oidn"),
    (DENSE, {"inputs": ("primal", "colour")}, "input 'colour' is unknown"),
    (DENSE, {"inputs": ("albedo",)}, "'primal' among them"),
    (DENSE, {"channels": (4, 4)}, "each of 2 levels"),
    (DENSE, {"base": "l2"}, "base is 'l2'"),
    (DENSE, {"pooling": "lanczos"}, "pooling 'lanczos': choose one of: convolution, average, maximum, bilinear"),
    (PLAIN, {"inputs": ("primal", "denoised_base")}, "there is no base"),
    (PLAIN, {"inputs": ("primal", "albedo"), "start": ("albedo",)}, "start 'albedo': must be one of"),
    (PLAIN, {"start": ("denoised",)}, "start 'denoised'"),
    (PLAIN, {"kernel": 3}, "kernel = 3: there is no image to average"),
    *((PLAIN, {"start": ("primal",), "kernel": size}, "must be an odd number of pixels from 3 to 17, or 0")
      for size in (1, 2, -1, 19, True, "3", 3.0)),
    (PLAIN, {"start": ("primal",), "kernel": 3}, "kernels need 2 scales or more"),
    (QUIET, {"inputs": ("primal", "base"), "quiet": 3}, "quiet = 3: goes over to the base"),
    *((QUIET, {"quiet": quiet}, "must be a finite relative standard error")
      for quiet in (-1, float("nan"), float("inf"), "very", True)),
    (OF_KERNELS, {"scales": 0}, "must be from 1 to the 3 levels of the network"),
    (OF_KERNELS, {"scales": 4}, "must be from 1 to the 3 levels of the network"),
    (OF_KERNELS, {"kernel": 0}, "kernels need 2 scales or more"),
    (OF_KERNELS, {"start": ()}, "there is no image to average"),
    (OF_KERNELS, {"inputs": ("primal",)}, "demodulate = True: true or false; needs scales and the input albedo"),
    (DRAWN, {"sweeps": -1}, "sweeps = -1"),
    (DRAWN, {"sweeps": 65}, "whole number up to 64"),
    (DRAWN, {"sweeps": True}, "sweeps = True"),
    (DRAWN, {"inputs": SLOPES[:-1]}, "dy_noise"),
    (DRAWN, {"channels": (4, 4, 4)}, "4 resolutions; the network has 3"),
    (OIDN, {"channels": (32, 32)}, "they must be"),
    (OIDN, {"units": (1,)}, "has none"),
    (OIDN, {"inputs": ("primal", "albedo", "normal")}, "must be base, albedo, normal"),
    (OIDN, {"base": "oidn"}, "choose one of"),
    (OIDN, {"quiet": 0.03, "kernel": 3}, "cannot be combined with quiet, kernel"),
]  # fmt: skip


@pytest.mark.parametrize(("right", "change", "message"), ROWS)
def test_networks_that_cannot_be(right, change, message):
    ModelConfig(**right)
    with pytest.raises(NgptError, match=message):
        ModelConfig(**right | change)


@pytest.mark.parametrize("factors", [(0.1,), (0, 0.5), (0.5, 0.1), (0.5, 2), (0.1, 0.2, 0.3)])
def test_augmentations_that_cannot_be(factors):
    with pytest.raises(NgptError, match="two factors"):
        Augmentation(quieter=factors)
