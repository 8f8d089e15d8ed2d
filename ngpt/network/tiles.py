"""Cuts images for networks: into tiles for ONNX Runtime, into spans for PyTorch and for the network that blends frames.

The result of a pixel depends on all pixels within the reach of the network. So each piece has a margin around its own
pixels, which are the pixels whose result is taken from this piece. Also, each piece begins at a multiple of the
network's alignment. Then cutting does not change the result.
"""

from itertools import product

# A way to cut one side of an image: for each piece, its own pixels and its beginning; and the length of all pieces.
Cuts = tuple[list[tuple[slice, int]], int]


def spans(length: int, step: int, margin: int) -> list[tuple[slice, slice]]:
    """For each piece of a side: its own pixels, and all of its pixels.

    A piece has ``step`` own pixels, and ``margin`` more at both ends. At the ends of the side, it has fewer pixels.
    """
    return [
        (slice(first, min(first + step, length)), slice(max(first - margin, 0), min(first + step + margin, length)))
        for first in range(0, length, step)
    ]


def within(inner: slice, outer: slice) -> slice:
    """The position of ``inner`` within ``outer``."""
    return slice(inner.start - outer.start, inner.stop - outer.start)


def plan(
    size: tuple[int, int], alignment: int, overlap: int, most: int
) -> tuple[list[tuple[slice, slice, int, int]], tuple[int, int]] | None:
    """Tiles (rows, columns, top, left) and their common (height, width), with the least total number of pixels.

    ``size`` is the (height, width) of the image. ``rows`` and ``columns`` are the own pixels of a tile, which begins at
    ``top`` and ``left``, and has at most ``most`` pixels. Returns None if the smallest tile has more than ``most``
    pixels.
    """
    best: tuple | None = None
    down, across = (_cuts(n, alignment, overlap) for n in size)
    for ys, tall in down:
        fitting = [(xs, wide) for xs, wide in across if tall * wide <= most]
        if fitting:
            xs, wide = fitting[0]
            work = len(ys) * len(xs) * tall * wide
            if best is None or work < best[0]:
                best = work, ys, xs, tall, wide
    if best is None:
        return None
    _, ys, xs, tall, wide = best
    return [(y, x, top, left) for (y, top), (x, left) in product(ys, xs)], (tall, wide)


def smallest(size: tuple[int, int], alignment: int, overlap: int) -> int:
    """The number of pixels of the smallest tile."""
    (*_, (_, low)), (*_, (_, narrow)) = (_cuts(n, alignment, overlap) for n in size)
    return low * narrow


def _cuts(length: int, alignment: int, overlap: int) -> list[Cuts]:
    """The ways to cut a side into pieces, the longest pieces first."""
    cuts: list[Cuts] = []
    for count in range(1, max(1, length // alignment) + 1):
        step = -(-length // (count * alignment)) * alignment
        starts = range(0, length, step)
        # All pieces have the same length, so the last pieces begin earlier than their margin requires. All begin at
        # multiples of the alignment. The first and the last piece have a neighbour on only one side.
        size = min(step + min(len(starts) - 1, 2) * overlap + length % alignment, length)
        pieces = [(slice(n, min(n + step, length)), min(max(n - overlap, 0), length - size)) for n in starts]
        if not cuts or size < cuts[-1][1]:
            cuts.append((pieces, size))
    return cuts
