"""The device that PyTorch computes on where none is asked for."""

import os

import torch


def default_device() -> torch.device:
    """The GPU that belongs to this process, which is one of several under ``torchrun``; or the CPU."""
    return torch.device(f"cuda:{os.environ.get('LOCAL_RANK', 0)}" if torch.cuda.is_available() else "cpu")
