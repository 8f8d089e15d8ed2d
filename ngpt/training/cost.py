"""Computes the cost of a network before it is trained."""

from typing import Any

import torch
from torch import nn

from ngpt.network import features, padding
from ngpt.network.device import default_device, in_bfloat16
from ngpt.network.model import Reconstructor, parameters
from ngpt.network.unet import Convolution, LastConvolution
from ngpt.sequence.network import INPUTS
from ngpt.training import temporal
from ngpt.training.settings import Settings


def network_of(settings: Settings) -> tuple[nn.Module, int]:
    """The network that a run trains, and the number of channels that it reads."""
    if settings.model is None:
        return temporal.network(), len(INPUTS)
    return Reconstructor(settings.model).network, features.channels(settings.model.inputs)


def per_pixel(model: Any, channels: int) -> tuple[float, float]:
    """(multiplications, numbers in the inputs and outputs of convolutions) for each pixel of the padded image."""
    size, macs, numbers = 8 * model.alignment, 0, 0

    def count(module: Any, args: tuple, output: torch.Tensor) -> None:
        nonlocal macs, numbers
        module = getattr(module, "convolution", module)
        weight = module.v if isinstance(module, Convolution) else module.weight
        # Each output pixel reads one tap of a transposed 2x2 kernel with stride 2, and all taps of other kernels.
        taps = weight.shape[0] if getattr(module, "kind", "") == "unpool" else weight[0].numel()
        macs += taps * output.numel()
        numbers += args[0].numel() + output.numel()

    # LastConvolution may not call its inner module, so only LastConvolution itself is counted.
    last = {m.convolution for m in model.modules() if isinstance(m, LastConvolution)}
    kinds = (Convolution, LastConvolution, torch.nn.Conv2d)
    hooks = [m.register_forward_hook(count) for m in model.modules() if isinstance(m, kinds) and m not in last]
    with torch.no_grad():
        device = next(model.parameters()).device
        model(torch.zeros(1, channels, size, size, device=device))
    for hook in hooks:
        hook.remove()
    return macs / size**2, numbers / size**2


def cost(settings: Settings) -> str:
    """Lines of text about parameters, multiplications and memory of a run."""
    (model, channels), run = network_of(settings), settings.run
    macs, numbers = per_pixel(model, channels)
    pixels = run.batch * (settings.data.crop + 2 * padding.MARGIN) ** 2
    # The backward pass costs twice as much as the forward pass.
    step = 3 * macs * pixels
    activations = numbers * pixels * (2 if in_bfloat16(default_device().type, run.precision) else 4)
    # Weights, gradients, two moments of Adam, and the average of the weights.
    states = parameters(model) * 4 * (5 if settings.optimizer.ema else 4)
    lines = {
        "parameters": f"{parameters(model):,}",
        "cost per pixel": f"{macs / 1e3:,.1f} thousand multiplications, {macs * 1280 * 720 / 1e9:,.1f} G at 1280x720",
    }
    # The size of the frames of shots depends on the training set, so their cost is unknown here.
    if not settings.temporal:
        lines |= {
            "cost per step": f"{step / 1e9:,.0f} G multiplications, forward and backward, batch {run.batch}",
            "whole run": f"{step * run.steps / 1e15:,.2f} P multiplications, {run.steps:,} steps",
            "memory": f"about {(activations + states) / 2**30:.2f} GiB while training",
        }
    return "\n".join(f"{name:<16}{value}" for name, value in lines.items())
