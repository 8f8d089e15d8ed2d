"""Runs the networks that come with the package, or a user's file in their place, on a repaired stack."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.network import inputs, run_oidn, run_onnx
from ngpt.options import Option
from ngpt.repair import Repaired
from ngpt.system.install import install_command, package_command

WEIGHTS = Path(__file__).parents[1] / "weights"

# The options of all networks.
OPTIONS = {
    "weights": Option("", "a file, .onnx, .safetensors or .tza, instead of the network that is shipped"),
    "device": Option(
        "auto", f"where it runs: {', '.join(run_onnx.DEVICES)}, or PyTorch's names for .safetensors and OIDN's for .tza"
    ),
    "memory": Option(run_onnx.MEMORY, "MiB that its tiles may take", range=(1, math.inf)),
}


@dataclass(frozen=True)
class Shipped:
    """The shipped network ``name``. The option ``weights`` puts a file in its place.

    ``also_missing``  returns what the network lacks on this machine, apart from ONNX Runtime and its own file; "" if it
                      lacks nothing
    """

    name: str
    also_missing: Callable[[], str] = str

    @property
    def path(self) -> Path:
        return WEIGHTS / f"{self.name}.onnx"

    def missing(self) -> str:
        """Why the network cannot be used on this machine; "" if it can."""
        if find_spec("onnxruntime") is None:
            return f"ONNX Runtime is not installed: {package_command('onnxruntime')}"
        if not self.path.is_file():
            return "no network is shipped for it: pass --weights FILE (weights=FILE), .onnx, .safetensors or .tza"
        return self.also_missing()

    def reads(self, weights: str, device: str, memory: int) -> tuple[str, ...]:
        """The names of the network's inputs (``inputs.gather``), and of the layers that a stack must hold for them.

        Raises NgptError for weights that cannot be loaded, and for a device that cannot be used.
        """
        path = Path(weights or self.path)
        if path.suffix == ".tza":
            run_oidn.check_device(device)
            names, base = run_oidn.reads(path)
            return (*names, *inputs.needs(names, base))
        if path.suffix != ".safetensors":
            network = run_onnx.Network(path, device)
            return (*network.inputs, *inputs.needs(network.inputs, network.base))
        config = self._torch(path).config_of(path, device)
        return (*config.layers, *config.needs)

    def run(self, data: Repaired, weights: str, device: str, memory: int) -> np.ndarray:
        """Reconstructs the data's ``image``: (H, W, 3) float32, scene-linear.

        ``weights``  a file in place of the shipped one: .onnx for ONNX Runtime, .safetensors for PyTorch, .tza for
                     OIDN; "" for the shipped one
        ``device``   a device of that runtime, or "auto"
        ``memory``   the MiB that tiles may take in ONNX Runtime and OIDN
        """
        path = Path(weights or self.path)
        if path.suffix == ".tza":
            return run_oidn.run(data, path, device, memory)
        if path.suffix != ".safetensors":
            network = run_onnx.Network(path, device)
            # NumPy computes the base several times faster than the graph.
            names = (*network.inputs, "base") if network.base else network.inputs
            layers = inputs.gather(data, names, network.base, f"weights {path}", estimate=True)
            return network.reconstruct(layers, memory=memory)
        return self._torch(path).run(data, path, device)

    def _torch(self, path: Path) -> Any:
        """The module ``ngpt.network.run_torch``, imported only if it is needed, since importing torch takes seconds."""
        if find_spec("torch") is None or find_spec("safetensors") is None:
            raise NgptError(f"weights {path}: to run them needs PyTorch: {install_command('train')}")
        from ngpt.network import run_torch

        return run_torch
