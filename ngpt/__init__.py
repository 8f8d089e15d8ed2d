"""ngpt: gradient-domain reconstruction of Monte Carlo renderings.

stack = ngpt.read("stack.exr")                 # GradientStack
image = ngpt.denoise(stack, method="l1")       # (H, W, 3) float32
ngpt.write("out.exr", image, like=stack)
"""

__version__ = "0.1.0"

from ngpt.denoiser import Denoiser
from ngpt.errors import NgptError
from ngpt.exr import read, read_image, write
from ngpt.merging import merge
from ngpt.methods import METHODS, Result, denoise, reconstruct
from ngpt.stack import GradientStack

__all__ = [
    "METHODS",
    "Denoiser",
    "GradientStack",
    "NgptError",
    "Result",
    "denoise",
    "merge",
    "read",
    "read_image",
    "reconstruct",
    "write",
]
