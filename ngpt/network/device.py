"""The default device of PyTorch, and its precision."""

import os

import torch


def default_device() -> torch.device:
    """The GPU that belongs to this process, which is one of several under ``torchrun``; or the CPU."""
    return torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if torch.cuda.is_available() else "cpu")


def in_bfloat16(device: str, precision: str) -> bool:
    """Whether this type of device computes in bfloat16 if a run asks for ``precision``, see ``RunSettings``.

    CPUs with AVX2 but without AVX-512 emulate it: a training step of ngpt-primal takes 6.5 times as long as in float32
    (docs/lab/log).
    """
    emulated = device == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2"
    return precision == "bfloat16" and not emulated


def body_precision(device: str, precision: str) -> torch.autocast:
    """A context for the convolutions of a network: ``precision`` is "float32" or "bfloat16"."""
    return torch.autocast(device, torch.bfloat16, enabled=in_bfloat16(device, precision))
