"""l2 of images that do not fit into memory: tile by tile, each solved with an apron that is thrown away.

What an equation contributes to the solution falls off as exp(-k d) with distance d in pixels, cosh k = 1 + α²/2. Beyond
an apron of ln(1e6) / k pixels, 70 at an α of 0.2, the influence is below a millionth, so the tiles are those of the
whole image to the rounding of float32. Small α reach far: 700 pixels at 0.02.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ngpt.classical.poisson import DEFAULT_ALPHA, check_alpha, l2

# With the apron on both sides 1024: a good length for the transforms, 70 MB of work space.
TILE = 880


def apron(alpha: float = DEFAULT_ALPHA) -> int:
    """Pixels of apron that leave less than 1e-6 of the influence of what is beyond it."""
    check_alpha(alpha)
    return math.ceil(math.log(1e6) / math.acosh(1 + float(alpha) ** 2 / 2)) + 2


def l2_tiled(
    read: Callable[[slice, slice], tuple],
    write: Callable[[slice, slice, np.ndarray], None],
    height: int,
    width: int,
    alpha: float = DEFAULT_ALPHA,
    tile: int = TILE,
) -> None:
    """``ngpt.classical.poisson.l2`` of an image of any size in the memory of one tile and its apron.

    ``read(rows, columns)`` returns what l2 takes, (primal, dx, dy) or (primal, dx, dy, trusted), of these slices of the
    image; ``write(rows, columns, image)`` receives the result, every pixel once, from top to bottom. Memory-mapped
    arrays will do: ``read = lambda rows, columns: (p[rows, columns], dx[rows, columns], dy[rows, columns])``.
    """
    margin = apron(alpha)
    for rows, rows_around in _spans(height, tile, margin):
        for columns, columns_around in _spans(width, tile, margin):
            primal, dx, dy, *trusted = read(rows_around, columns_around)
            image = l2(primal, dx, dy, alpha, *trusted)
            top, left = rows.start - rows_around.start, columns.start - columns_around.start
            inner = np.s_[top : top + rows.stop - rows.start, left : left + columns.stop - columns.start]
            write(rows, columns, image[inner])


def _spans(length: int, tile: int, margin: int) -> list[tuple[slice, slice]]:
    """Intervals of at most ``tile`` that cover 0 .. length, and the same with a margin on both sides."""
    count = math.ceil(length / tile)
    edges = [length * i // count for i in range(count + 1)]
    return [(slice(a, b), slice(max(a - margin, 0), min(b + margin, length))) for a, b in pairwise(edges)]
