"""Runs networks of OIDN's shape (``ngpt.network.oidnet``) in OIDN's runtime, from .tza files, without PyTorch."""

from pathlib import Path

import numpy as np

from ngpt.denoisers.oidn import require_oidn
from ngpt.errors import NgptError
from ngpt.network import inputs, tza
from ngpt.repair import Repaired

# By the names of OIDN's devices in Python.
DEVICES = {"auto": "Default", "cpu": "CPU", "cuda": "CUDA", "hip": "HIP", "metal": "Metal", "sycl": "SYCL"}


def reads(path: Path) -> tuple[tuple[str, ...], str]:
    """The names of what the network of a file reads (``inputs.gather``), colour first, and its base, "" for none."""
    _, colour = tza.read(path)
    return ("primal" if colour == "primal" else "base", "albedo", "normal"), colour.removeprefix("primal")


def run(data: Repaired, path: Path, device: str = "auto", memory: int = 3072) -> np.ndarray:
    """The image (H, W, 3) float32, scene-linear, of the light that the data's ``image`` is of, by that file's weights.

    ``device``  one of ``DEVICES``; ``memory``  MiB that OIDN's tiles may take. OIDN has no bound of its own: no pixel
    becomes brighter than the brightest of the colour.
    """
    names, base = reads(path)
    layers = inputs.gather(data, names, base, f"weights {path}", estimate=True)
    colour, albedo, normal = (np.ascontiguousarray(layers[name], np.float32) for name in names)
    image = filtered(tza.read(path)[0], colour, albedo, normal, device, memory, str(path))
    return np.minimum(image, max(float(colour.max()), 0))


def filtered(
    weights: bytes, colour: np.ndarray, albedo: np.ndarray, normal: np.ndarray, device: str, memory: int, path: str
) -> np.ndarray:
    """OIDN's filter "RT" for HDR images with weights in the place of its own; arrays are (H, W, 3) float32."""
    require_oidn()
    import mitsuba_oidn as oidn

    if device not in DEVICES:
        raise NgptError(f"device '{device}' is unknown; those of OIDN are: {', '.join(DEVICES)}")
    height, width, _ = colour.shape
    try:
        holder = oidn.Device(getattr(oidn.DeviceType, DEVICES[device]))
        by_weights = holder.new_filter("RT")
        by_weights.hdr, by_weights.max_memory_mb = True, memory
        by_weights.set_data("weights", weights)
        buffers = []
        for name, image in (("color", colour), ("albedo", albedo), ("normal", normal), ("output", colour)):
            buffers.append(holder.new_buffer(image.nbytes))
            if name != "output":
                buffers[-1].write(image)
            by_weights.set_image(name, buffers[-1], format=oidn.Format.Float3, width=width, height=height)
        by_weights.execute()
        result = np.empty_like(colour)
        buffers[-1].read(result)
    except (oidn.Error, RuntimeError, TypeError, ValueError) as error:
        message = " ".join(str(error).split())
        raise NgptError(f"weights {path}: OIDN cannot run them on device '{device}': {message}") from error
    return result
