"""Runs networks of OIDN's shape (``ngpt.network.oidnet``) from .tza files in OIDN, without PyTorch."""

from pathlib import Path

import numpy as np

from ngpt.denoisers.oidn import require_oidn
from ngpt.denoisers.oidn_filters import DEVICES, filtered
from ngpt.errors import NgptError
from ngpt.network import inputs, tza
from ngpt.repair import Repaired


def reads(path: Path) -> tuple[tuple[str, ...], str]:
    """The names of the network's inputs for ``inputs.gather``, colour first, and of its base ("" for none)."""
    _, colour = tza.read(path)
    return ("primal" if colour == "primal" else "base", "albedo", "normal"), colour.removeprefix("primal")


def check_device(device: str) -> None:
    """Raises NgptError if OIDN is not installed, and for an unknown device."""
    require_oidn()
    if device not in DEVICES:
        raise NgptError(f"device '{device}' is unknown; OIDN has: {', '.join(DEVICES)}")


def run(data: Repaired, path: Path, device: str = "auto", memory: int = 3072) -> np.ndarray:
    """Reconstructs the data's ``image`` with the weights in a file: (H, W, 3) float32, scene-linear.

    ``device``  one of ``DEVICES``
    ``memory``  the MiB that OIDN's tiles may take

    The result is clamped to the brightest value of the colour, because OIDN does not bound it.
    """
    names, base = reads(path)
    layers = inputs.gather(data, names, base, f"weights {path}", estimate=True)
    colour, albedo, normal = (np.ascontiguousarray(layers[name], np.float32) for name in names)
    check_device(device)
    images = {"color": colour, "albedo": albedo, "normal": normal}
    try:
        image = filtered(images, device, tza.read(path)[0], hdr=True, max_memory_mb=memory)
    except NgptError as error:
        raise NgptError(f"weights {path}: {error}") from error
    return np.minimum(image, max(float(colour.max()), 0))
