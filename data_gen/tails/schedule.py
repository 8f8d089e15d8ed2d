"""When the cache is fed, how much, and how fine its cells are: all by the number of paths of the image.

So large images have as many rounds as small ones with more samples; and the cache is the same after the same number of
paths, whether samples or time end the render.
"""

from __future__ import annotations

# The cache begins with the first round before which the image has this number of paths, or at once if the image has
# this number of pixels. Small images of few samples have none: it would take longer to compile than they take.
BEGIN = 1 << 14
# Paths of the image at the end of the first round, or more
FIRST = 1 << 16
# The fineness of cells: how many times smaller they are than the spread of a path. It grows slowly with the paths of
# the image, from this number on. Bias falls with the square of the size of cells, and so at the rate of noise.
FINENESS, _COARSE, _RATE = 8.0, 1 << 20, 1 / 4


def enough(pixels: int, spp: int | None) -> bool:
    """Whether a render of this size should have a cache; ``spp`` None: the number of samples is not known."""
    return spp is None or spp > first_sample(pixels)


def first_sample(pixels: int) -> int:
    """The number of the first sample whose paths may end in the cache: a power of two, or 0 where images are large."""
    return 0 if pixels >= BEGIN else _power_of_two(BEGIN / pixels)


def end_of_round(sample: int, pixels: int) -> int:
    """The number of the first sample that is in a later round than ``sample``, from ``first_sample`` on."""
    return max(_power_of_two(FIRST / pixels), 1 << sample.bit_length())


def fineness(paths: int) -> float:
    """The fineness of cells in a round after which the image has this number of ``paths``."""
    return FINENESS * max(1.0, paths / _COARSE) ** _RATE


def _power_of_two(least: float) -> int:
    n = 1
    while n < least:
        n *= 2
    return n
