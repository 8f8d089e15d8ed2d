"""The sweeps of ``ngpt.classical.controlvariates`` on NumPy arrays, arranged for the caches of a processor.

It is faster than plain NumPy expressions over bands of an image (docs/lab/log), because:

- The image is cut into strips of rows, and each thread works on a strip. A strip has ``DEPTH`` more rows at both ends,
  which are copies of its neighbours' rows. So strips need no exchange for ``DEPTH`` sweeps: errors at the ends of a
  strip move inwards by one row in each sweep.
- Within a strip, each sweep follows the previous one at a distance of one row, on blocks of rows in the cache.
- There are few calls of NumPy, each for both directions and all colours. At its end, a call takes Python's lock, and a
  thread that waits for the lock sleeps. With many short calls, two threads are slower than one.
- Rows are padded to whole vectors and laid end to end, so that operations read one long aligned array. The difference
  between the last pixel of a row and the first pixel of the next row has weight 0.
"""

import math
from functools import partial
from itertools import pairwise

import numpy as np

from ngpt.classical.arrays import map_silent

# Sweeps between two exchanges of rows.
DEPTH = 6
# Rows of a strip without the copied rows. Fewer rows mean more copies; with more rows, some threads have no work.
_STRIP = 180
# Pixels that are processed at a time. Fewer need more calls; more do not fit into the cache.
_PIXELS = 30720
# Bytes of the widest vectors. Operations on addresses that are not multiples of this take twice as long.
_VECTOR = 64


def jacobi(
    r: np.ndarray, primal_var: np.ndarray, difference_var: np.ndarray, schedule: list[tuple[float, float]]
) -> np.ndarray:
    """The correction u (C, H, W) after one sweep for each entry (f, s) of ``schedule``, see ``controlvariates``.

    ``r``               (2, C, H, W), the residuals of the differences; overwritten, since u is in its memory
    ``primal_var``      (1, H, W) > 0
    ``difference_var``  (2, 1, H, W), infinite where there is no difference

    All are float32 or float64.
    """
    height = r.shape[2]
    count = max(1, round(height / _STRIP))
    cuts = [height * i // count for i in range(count + 1)]
    strips = map_silent(lambda rows: _Strip(r, primal_var[0], difference_var[:, 0], *rows), pairwise(cuts))
    for first in range(0, len(schedule), DEPTH):
        now = schedule[first : first + DEPTH]
        if first:
            for upper, lower in pairwise(strips):
                upper.exchange(lower)
        map_silent(partial(_Strip.run, schedule=now), strips)
    u = r[0]
    for strip in strips:
        u[:, strip.first : strip.last] = strip.inner
    return u


class _Strip:
    """Rows first .. last - 1 of the image, and ``DEPTH`` more on both sides.

    All arrays are (..., rows * pitch). ``ratio`` is the variance of the difference over the variance of the pixel, for
    the neighbours right, below, left and above; infinite without a neighbour.
    """

    def __init__(self, r: np.ndarray, v: np.ndarray, differences: np.ndarray, first: int, last: int):
        channels, height, width = r.shape[1:]
        self.first, self.last, self.width, dtype = first, last, width, r.dtype
        self.lead = _VECTOR // dtype.itemsize
        self.pitch = -(-width // self.lead) * self.lead
        self.rows = last - first + 2 * DEPTH
        # The rows that exist in the image, as slices of the image and of the strip.
        image = slice(max(first - DEPTH, 0), min(last + DEPTH, height))
        strip = slice(image.start - first + DEPTH, image.stop - first + DEPTH)
        size = self.rows * self.pitch
        # With one more row above and one below, which no difference connects.
        self.u = _aligned((channels, size + 2 * self.pitch), dtype, 0)
        self.r = _aligned((2, channels, size), dtype, 0)
        # For each pixel, its neighbours to the right and below.
        self.neighbours = _pair(self.u[:, self.pitch + 1 :], self.u[:, 2 * self.pitch :], size)
        self.ratio = _aligned((4, size), dtype, np.inf)
        self._grid(self.r)[:, :, strip, :width] = r[:, :, image]
        right, below, left, above = self._grid(self.ratio)[:, strip, :width]
        v, (vx, vy) = v[image], differences[:, image]
        np.divide(vx, v, out=right)
        np.divide(vy, v, out=below)
        np.divide(vx[:, :-1], v[:, 1:], out=left[:, 1:])
        np.divide(vy[:-1], v[1:], out=above[1:])

    @property
    def inner(self) -> np.ndarray:
        """The correction in the strip's own rows, (C, last - first, W)."""
        return self._grid(self.u)[:, DEPTH + 1 : -DEPTH - 1, : self.width]

    def exchange(self, lower: "_Strip") -> None:
        """Copies rows between this strip and the one below."""
        here, below = self._grid(self.u)[:, 1:-1], self._grid(lower.u)[:, 1:-1]
        here[:, -DEPTH:], below[:, :DEPTH] = below[:, DEPTH : 2 * DEPTH], here[:, -2 * DEPTH : -DEPTH]

    def run(self, schedule: list[tuple[float, float]]) -> None:
        """One sweep for each entry, each one row behind the one before."""
        rows = max(1, _PIXELS // self.pitch)
        scratch = _Scratch(self, rows)
        numbers = np.array(schedule, self.u.dtype)
        for bottom in range(rows, self.rows + len(numbers) + rows - 1, rows):
            for late, (factor, step) in enumerate(numbers):
                top, end = max(bottom - rows - late, 0), min(bottom - late, self.rows)
                if top < end:
                    self._rows(top, end, factor, step, scratch, scratch.above[late])

    def _rows(
        self, top: int, end: int, factor: np.floating, step: np.floating, scratch: "_Scratch", above: np.ndarray
    ) -> None:
        """One sweep over rows top .. end - 1.

        ``above`` (C, pitch) is d of dy for the row above ``top``, as it was before this sweep changed that row. It is
        replaced by d of row end - 1, for the next call. See ``_Scratch`` for d.
        """
        pitch, first, last = self.pitch, top * self.pitch, end * self.pitch
        size = last - first
        weights, share, d, before, said = (a[..., :size] for a in scratch.arrays)
        u = self.u[:, first + pitch : last + pitch]
        np.add(self.ratio[:, first:last], factor, out=weights)
        np.divide(factor, weights, out=weights)
        np.add.reduce(weights, axis=0, initial=1, out=share)
        share /= step
        np.subtract(self.neighbours[..., first:last], u, out=d)
        d -= self.r[..., first:last]
        # d of the row above, as it was before this sweep changed that row.
        scratch.rows[:, :pitch] = above
        above[...] = scratch.rows[:, size : size + pitch]
        np.multiply(weights[2:, None], before, out=said)
        d *= weights[:2, None]
        d -= said
        change = np.add(d[0], d[1], out=d[0])
        change /= share
        u += change

    def _grid(self, flat: np.ndarray) -> np.ndarray:
        return flat.reshape(*flat.shape[:-1], -1, self.pitch)


class _Scratch:
    """The memory for sweeps over this number of rows.

    ``arrays``  (..., pixels): the weights of the four neighbours; the sum of these weights and the pixel's own; d,
                which is the estimate by the right and by the lower neighbour minus the pixel; d of the pixels to the
                left and above; and scratch space of the same size
    ``rows``    (C, pixels): d of the lower neighbours, with one more row at the top
    ``above``   (sweeps, C, pitch): for each sweep, d of the row above its next rows
    """

    def __init__(self, strip: _Strip, rows: int):
        channels, pitch, dtype = len(strip.u), strip.pitch, strip.u.dtype
        size = rows * pitch
        d = _aligned((2, channels, pitch + size), dtype, 0)
        self.rows, here = d[1], d[..., pitch:]
        self.arrays = (
            _aligned((4, size), dtype),
            _aligned((size,), dtype),
            here,
            _pair(d[0, :, pitch - 1 :], d[1], size),
            _aligned((2, channels, size), dtype),
        )
        self.above = _aligned((DEPTH, channels, pitch), dtype, 0)


def _pair(a: np.ndarray, b: np.ndarray, size: int) -> np.ndarray:
    """The first ``size`` columns of two views (C, ...) of one array as one view (2, C, size)."""
    apart = b.ctypes.data - a.ctypes.data
    return np.lib.stride_tricks.as_strided(a, (2, len(a), size), (apart, *a.strides))


def _aligned(shape: tuple[int, ...], dtype: np.dtype, value: float | None = None) -> np.ndarray:
    """An array whose address is a multiple of ``_VECTOR``, filled with ``value`` unless that is None."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + _VECTOR, np.uint8)
    start = -memory.ctypes.data % _VECTOR
    array = memory[start : start + size].view(dtype).reshape(shape)
    if value is not None:
        array.fill(value)
    return array
