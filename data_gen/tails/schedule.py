"""When the cache is fed, and how fine its cells are.

Both depend only on the number of paths of the image so far. So a large image has as many rounds as a small image with
the same number of paths. After the same number of paths the cache is the same, whether a number of samples or a time
ends the render.
"""

from __future__ import annotations

import math

# The cache begins when the image has this number of paths, or at once if the image has this number of pixels. Small
# images of few samples have no cache: compiling its kernels would take longer than rendering these images.
BEGIN = 1 << 14
# The least number of paths of the image at the end of the first round
FIRST = 1 << 16
# The fineness of cells says how many times smaller they are than the spread of a path, which is the width of the bundle
# of similar paths (``data_gen.tails.cache``). The fineness is FINENESS at first. From _COARSE paths of the image on, it
# grows as the power _RATE of the number of paths. The bias falls with the square of the size of cells, so it falls as
# 1 / sqrt(paths), which is as fast as noise.
FINENESS, _COARSE, _RATE = 8.0, 1 << 20, 1 / 4


def enough(pixels: int, spp: int | None) -> bool:
    """Whether a render of this size should have a cache; ``spp`` None: the number of samples is not known."""
    return spp is None or spp > first_sample(pixels)


def first_sample(pixels: int) -> int:
    """The number of the first sample whose paths may end in the cache: a power of two, or 0 for large images."""
    return 0 if pixels >= BEGIN else _power_of_two(BEGIN / pixels)


def end_of_round(sample: int, pixels: int) -> int:
    """The number of the first sample after the round of ``sample``. ``sample`` is at least ``first_sample``."""
    return max(_power_of_two(FIRST / pixels), 1 << sample.bit_length())


def fineness(paths: int) -> float:
    """The fineness of cells in a round after which the image has this number of ``paths``."""
    return FINENESS * max(1.0, paths / _COARSE) ** _RATE


def _power_of_two(least: float) -> int:
    return 1 << (math.ceil(least) - 1).bit_length()
