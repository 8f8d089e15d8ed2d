"""When the cache is fed, and how fine its cells are: only the number of samples decides, never passes or time."""

from __future__ import annotations

# Paths that feed the cache, for each sample of the image
SHARE = 1 / 8
# Such paths of the first round at least, however small the image is; and paths of a render for which that is little
FEWEST = 1 << 13
LEAST_PATHS = 8 * FEWEST
# MiB that the cache takes, and of those a render may use, what makes this little
MIB, LEAST_MIB = 160, 512
# Samples of the first round; each further one has as many as there are before it.
FIRST = 8
# The fineness of cells: how many times smaller they are than the spread of a path. It grows slowly with the samples, so
# that bias vanishes with noise.
FINENESS, _RATE = 16.0, 1 / 6
# A path may end where its spread has reached this share of its way to the first rough surface.
NEAR = 1 / 8


def enough(pixels: int, spp: int | None) -> bool:
    """Whether a render of so many pixels has paths enough for a cache; without ``spp``, by the first round."""
    return pixels * (spp or FIRST) >= LEAST_PATHS


def end_of_round(sample: int) -> int:
    """The number of the first sample that is in a later round than ``sample``."""
    return FIRST if sample < FIRST else 1 << sample.bit_length()


def paths_before(sample: int, spp: int | None) -> float:
    """Paths per pixel that have fed the cache before the round that begins with this ``sample``, of ``spp`` in all."""
    end = end_of_round(sample)
    return SHARE * (end if spp is None else min(end, spp))


def fineness(sample: int) -> float:
    """The fineness of cells in the round that this ``sample`` is in."""
    return FINENESS * max(1.0, end_of_round(sample) / 128) ** _RATE
