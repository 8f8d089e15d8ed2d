"""The device that PyTorch computes on where none is asked for, and how precisely."""

import os

import torch


def default_device() -> torch.device:
    """The GPU that belongs to this process, which is one of several under ``torchrun``; or the CPU."""
    return torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if torch.cuda.is_available() else "cpu")


def emulates_bfloat16(device: str) -> bool:
    """Whether PyTorch takes longer in bfloat16 than in float32 on this type of device: on CPUs that end with AVX2.

    A training step of ngpt-primal takes 6.5 times as long there (docs/lab/log).
    """
    return device == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2"


def body_precision(device: str, precision: str) -> torch.autocast:
    """A context for the convolutions of a network: ``precision`` is "float32" or "bfloat16", see ``RunSettings``."""
    return torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16" and not emulates_bfloat16(device))
