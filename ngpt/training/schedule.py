"""The learning rate as a function of the step, and the average of the weights."""

import math

import torch
from torch import nn

from ngpt.training.settings import OptimizerSettings


def learning_rate(settings: OptimizerSettings, step: int, steps: int) -> float:
    """The learning rate of a ``step`` from 0 to ``steps`` - 1. ``settings.schedule`` says how it changes:

    paper    grows exponentially from 1e-4 of the rate to the full rate at ``warmup``, is constant until ``flat``, then
             halves every ``half_life`` steps [Kettunen et al. 2019, section 5.3, and their code]
    cosine   grows linearly until ``warmup``, then falls as half a cosine to 1 % at the last step
    """
    rate, warmup = settings.learning_rate, warmup_of(settings, steps)
    if settings.schedule == "paper":
        if step < warmup:
            return rate * 1e-4 ** (1 - step / warmup)
        return rate * 0.5 ** (max(0, step - settings.flat) / settings.half_life)
    if step < warmup:
        return rate * (step + 1) / warmup
    done = (step - warmup) / max(1, steps - 1 - warmup)
    return rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


def warmup_of(settings: OptimizerSettings, steps: int) -> int:
    """The steps of the warm-up: ``warmup``, or a tenth of the run if the run is not longer than ``warmup``."""
    return settings.warmup if settings.warmup < steps else steps // 10


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float, step: int) -> None:
    """average <- d average + (1 - d) model. d grows to ``decay``, so that the first weights soon lose influence."""
    decay = min(decay, (1 + step) / (10 + step))
    for mean, value in zip(average.parameters(), model.parameters(), strict=True):
        mean.lerp_(value, 1 - decay)
