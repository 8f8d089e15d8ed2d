"""ngpt: gradient-domain reconstruction of Monte Carlo renderings.

stack = ngpt.read("stack.exr")                 # GradientStack
image = ngpt.denoise(stack, method="l1")       # (H, W, 3) float32
ngpt.write("out.exr", image, like=stack)

image = ngpt.denoise(noisy, albedo=albedo, normal=normal)       # arrays, tensors, bitmaps; the same kind comes back
denoiser = ngpt.Denoiser(size, albedo=True, normals=True)       # called as mi.OptixDenoiser is
temporal = ngpt.Temporal()                                      # frames of a shot: image = temporal.next(stack, image)

help(ngpt.denoise) lists the methods with the layers that they need and their options. The logger "ngpt" reports the
files, layers and methods in use.
"""

import logging
import os
from importlib import import_module
from typing import TYPE_CHECKING

from ngpt.version import __version__ as __version__

if TYPE_CHECKING:
    from ngpt.api.arrays import Denoiser as Denoiser
    from ngpt.api.arrays import denoise as denoise
    from ngpt.api.uncertainty import reconstruct_with_error as reconstruct_with_error
    from ngpt.errors import NgptError as NgptError
    from ngpt.io.exr import read as read
    from ngpt.io.exr import read_image as read_image
    from ngpt.io.exr import read_views as read_views
    from ngpt.io.exr import write as write
    from ngpt.merging import merge as merge
    from ngpt.methods import METHODS as METHODS
    from ngpt.methods import Result as Result
    from ngpt.methods import reconstruct as reconstruct
    from ngpt.sequence.history import Temporal as Temporal
    from ngpt.stack import GradientStack as GradientStack
    from ngpt.system.limits import limit_threads as limit_threads

# Official builds of ONNX Runtime send telemetry (SECURITY.md) unless this variable is set when ONNX Runtime is loaded.
# Other code, such as PyTorch's exporters, may load it before ngpt does, so the variable is set at once.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

# Nothing is logged unless a program sets a handler and a level: logging.getLogger("ngpt").setLevel("INFO").
logging.getLogger("ngpt").addHandler(logging.NullHandler())

# The module of each public name. A module is imported when one of its names is first used, so that importing this
# package does not load NumPy and SciPy. So commands start, and handle interrupts, at once.
_HOMES = {"GradientStack": "stack", "NgptError": "errors", "Temporal": "sequence.history", "merge": "merging"}
_HOMES |= {"limit_threads": "system.limits", "reconstruct_with_error": "api.uncertainty"}
_HOMES |= dict.fromkeys(("METHODS", "Result", "reconstruct"), "methods")
_HOMES |= dict.fromkeys(("Denoiser", "denoise"), "api.arrays")
_HOMES |= dict.fromkeys(("read", "read_image", "read_views", "write"), "io.exr")
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'ngpt' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(f"ngpt.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
