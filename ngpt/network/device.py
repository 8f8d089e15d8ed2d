"""The default device of PyTorch, and the precision of networks."""

import os

import torch


def default_device() -> torch.device:
    """The GPU of this process, or the CPU if there is no GPU. ``torchrun`` gives each process its own GPU."""
    return torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if torch.cuda.is_available() else "cpu")


def in_bfloat16(device: str, precision: str) -> bool:
    """Whether networks run in bfloat16 on the device "cpu" or "cuda"; ``precision`` is that of ``RunSettings``.

    CPUs with AVX2 but without AVX-512 only emulate bfloat16: a training step of ngpt-primal takes 6.5 times as long as
    in float32 (docs/lab/log). There, networks run in float32.
    """
    emulated = device == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2"
    return precision == "bfloat16" and not emulated


def body_precision(device: str, precision: str) -> torch.autocast:
    """A context in which convolutions run in float32 or bfloat16, as ``in_bfloat16`` decides."""
    return torch.autocast(device, torch.bfloat16, enabled=in_bfloat16(device, precision))
