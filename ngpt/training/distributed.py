"""Training in one process, or in several processes that ``torchrun`` has started."""

import os

import torch
import torch.distributed as dist
from torch import nn

from ngpt.network.device import default_device


class Processes:
    """The processes of a run: only this one, unless ``torchrun`` has started several.

    ``rank``    the number of this process, from 0
    ``count``   the number of processes
    ``device``  the GPU of this process, or the CPU
    """

    def __init__(self) -> None:
        self.rank, self.count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        self.device = default_device()
        cuda = self.device.type == "cuda"
        if cuda:
            torch.cuda.set_device(self.device)
        if self.count > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if cuda else "gloo")

    def average_gradients(self, module: nn.Module) -> None:
        """Replaces each gradient by its mean over all processes."""
        if self.count == 1:
            return
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        # One message of a few megabytes takes less time than a hundred small ones.
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        for gradient, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is true in any process. All processes get the same answer, so they stop at the same step."""
        if self.count == 1:
            return flag
        value = torch.tensor(float(flag), device=self.device)
        dist.all_reduce(value, dist.ReduceOp.MAX)
        return bool(value.item())

    def close(self) -> None:
        if dist.is_initialized():
            dist.destroy_process_group()
