"""One small network of every kind, and layers for it to read: what all networks must do is tested on each."""

import pytest
import torch

from ngpt.errors import NgptError
from ngpt.network import features
from ngpt.network.config import KINDS
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.oidnet import SHAPES
from ngpt.network.safetensors import save_weights
from ngpt.network.transfer import signed_exp

ALL = ("primal", "dx", "dy", "albedo", "normal", "depth")
SPLIT = ("primal", "diffuse", "specular", "diffuse_se", "specular_se", "albedo", "normal")
SLOPES = ("primal", "albedo", "base", "dx_base", "dy_base", "primal_noise", "dx_noise", "dy_noise")


def dense(inputs, *rest, channels=(4, 6), **more):
    return ModelConfig("dense", channels, (1,) * len(channels), inputs, *rest, **more)


def plain(inputs, *rest, channels=(4, 4, 4, 4), **more):
    return ModelConfig("plain", channels, (), inputs, *rest, **more)


PYRAMID = {"start": ("primal",), "kernel": 3, "scales": 3, "demodulate": True}
OF_TWO = {"start": ("primal", "base"), "kernel": 5, "scales": 2}
# Those that ONNX graphs are made of; the name says what others have not.
GRAPHED = {
    "with all": dense(
        (*ALL, "base", "primal_se", "dx_se", "dy_se", "denoised", *features.SOURCES),
        "wcv",
        start=("base", "denoised", "denoised_base"),
    ),
    "relative to its base": dense(
        ("primal", "base", "primal_change", "dx_base", "dy_base", "dx_noise"), "wcv", start=("primal", "base")
    ),
    "converging": dense(("primal", "base", "primal_noise", "dx_se"), "wcv", start=("primal", "base"), quiet=1.0),
    "of a primal alone": dense(("primal", "primal_change", "primal_noise"), start=("primal", "denoised")),
    "by kernels of two": dense(("primal", "base", "dx_se", "primal_se"), "wcv", quiet=1.0, **OF_TWO),
    "as published": ModelConfig("dense", (4, 4), (2, 1), ALL),
    "without features": plain(("primal", "dx", "dy"), channels=(6, 8)),
    "by a pyramid of kernels": dense(("primal", "albedo", "normal"), channels=(4, 6, 6), **PYRAMID),
    "primal alone": plain(("primal",), channels=(4, 4, 4, 4, 4)),
    "halved by averages": dense(("primal",), channels=(3, 4), pooling="average"),
    "halved by maxima": dense(("primal",), channels=(3, 4), pooling="maximum"),
    "halved by lines": dense(("primal",), channels=(3, 4), pooling="bilinear"),
    "drawn to gradients": plain(SLOPES, "wcv", start=("base",), sweeps=2),
    "a choice drawn to gradients": plain(SLOPES, "wcv", start=("primal", "base"), sweeps=2),
    "a pyramid drawn to gradients": plain(SLOPES, "wcv", sweeps=2, **PYRAMID | {"scales": 2}),
}
NETWORKS = GRAPHED | {
    "by wide kernels": plain(("primal", "albedo"), channels=(4, 4), start=("primal",), kernel=17, scales=2),
    "of OIDN's shape": ModelConfig("oidn", next(iter(SHAPES)), (), ("base", "albedo", "normal"), "wcv"),
}
# What holds for every network holds for that of ngpt-studies, where it is installed.
if "kpcn" in KINDS:
    NETWORKS["kernels of two parts"] = ModelConfig("kpcn", (6,), (2,), SPLIT, kernel=21)


def untrained(config, deviation=0.1):
    """A network with weights at random, none of which is zero."""
    torch.manual_seed(0)
    model = Reconstructor(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += deviation * torch.randn_like(parameter)
    return model


def layers_for(config, height, width, seed=0):
    """Random layers (1, C, H, W) from 0 to 1, all that the network reads."""
    generator = torch.Generator().manual_seed(seed)
    names = dict.fromkeys((*config.layers, "primal"))
    return {name: torch.rand(1, features.CHANNELS[name], height, width, generator=generator) for name in names}


def brighter(layers, factor):
    return {name: layer * factor if name in features.RADIANCE else layer for name, layer in layers.items()}


def image_of(prediction, given, head):
    return signed_exp(head.forward(prediction, given))


def close(one, other):
    return torch.allclose(one, other, rtol=1e-4)


def no_graph(folder, config):
    """Whether the export of such a network is refused, with what runs it."""
    pytest.importorskip("onnxscript")
    from ngpt.export.network import network_model

    save_weights(folder / "w.safetensors", Reconstructor(config), {})
    with pytest.raises(NgptError, match="for which there is no ONNX graph; run its weights in PyTorch"):
        network_model(folder / "w.safetensors", "mine")
    return True
