"""What broken inputs are given to: a function of the input's number and a folder to work in, for each target.

A target returns where the input is accepted and handled, raises NgptError where it is refused, and anything else is a
failure. Number -1 is a whole input.
"""

from pathlib import Path

import numpy as np
from exr_mutations import mutate, seeds

import ngpt
from ngpt.exr import read, write
from ngpt.methods import reconstruct


def exr(number: int, folder: Path) -> None:
    """What `ngpt denoise` does with a file: reads, reconstructs, writes; what is written can be read again."""
    path, result = folder / "stack.exr", folder / "result.exr"
    path.write_bytes(seeds()[0][1] if number < 0 else mutate(number)[1])
    stack = read(path)
    method = "l2" if "dx" in stack and "dy" in stack else "primal"
    image = reconstruct(stack, method).image
    assert image.shape == stack["primal"].shape and np.isfinite(image).all()
    write(result, image, like=stack, overwrite=True)
    ngpt.read_image(result)


TARGETS = {"exr": exr}
