"""The diffusion of ``ngpt.denoisers.caustic`` on NumPy arrays, arranged for the caches of a processor.

It takes as little processor time as NumPy allows (docs/lab/log):

- Rows are laid end to end with a gap after each, and with empty rows above and below. So a neighbour at any distance
  has the same offset from all pixels. Borders need no special case: the surfaces of a gap are so far away that nothing
  is exchanged with them.
- Some thousand pixels are processed at a time, which stay in the cache.
- The exchange between two pixels is computed once and stored for both. Then each pixel is a weighted sum over 3x3.
- No exponential is so small that a processor computes it slowly, and smaller shares are exactly 0.
"""

import numpy as np

from ngpt.classical.arrays import map_silent

# The distances in pixels, one pass each. The last two smooth the grids that the larger distances leave.
DISTANCES = (1, 2, 4, 8, 16, 32, 1, 2)
# If the light of two pixels differs by this number of standard deviations beyond its noise, they exchange 1/e as much.
SIGNIFICANT = 3.0
# The neighbours of one half plane at distance 1, and their weights in the binomial filter of 3x3 pixels.
NEIGHBOURS = ((0, 1, 1 / 8), (1, 0, 1 / 8), (1, 1, 1 / 16), (1, -1, 1 / 16))
# Pixels that are processed at a time. Fewer need more calls; more do not fit into the cache.
_PIXELS = 16384
# The value of surfaces in gaps.
_FAR = float(np.finfo(np.float32).max)
# The largest negative logarithm of a share, and that share itself.
SMALLEST = np.float32(20)
_LEAST = np.exp(np.full(1, -SMALLEST))


def diffused(light: np.ndarray, variance: np.ndarray, surfaces: np.ndarray) -> np.ndarray:
    """``light`` (C, H, W), spread by the diffusion, with the same sum.

    ``variance`` (H, W) is the variance of ``light``, and ``surfaces`` (N, H, W) are features. All arrays are float32
    and finite. Two pixels whose ``surfaces`` differ by 1 exchange 1/e as much as with equal ones.
    """
    floor = np.float32(1e-12 * np.mean(light**2) + 1e-37)
    layout = _Layout(*variance.shape)
    now = layout.laid(light, 0), layout.laid(variance[None], 0)
    after = np.zeros_like(now[0]), np.zeros_like(now[1])
    # Without surfaces, a constant one still separates pixels from gaps.
    surface = layout.laid(surfaces if len(surfaces) else np.zeros((1, *variance.shape), np.float32), _FAR)
    shares = np.zeros((3, 3, layout.size + layout.margin), np.float32)
    for distance in DISTANCES:
        around = [layout.around(layer, distance) for layer in (*now, surface)]
        inner = [layer[:, layout.margin :] for layer in after]
        for down, right, _ in NEIGHBOURS:
            # Clears values of a smaller distance, where this distance writes nothing.
            shares[1 - down, 1 - right, : layout.offset(down, right, distance)] = 0

        def share(first: int, distance: int = distance, around: list = around) -> None:
            light, variance, surface = (layer[..., first : first + _PIXELS] for layer in around)
            found_shares = _shares(light, variance, surface, floor)
            for (down, right, _), found in zip(NEIGHBOURS, found_shares, strict=True):
                other = first + layout.offset(down, right, distance)
                shares[1 + down, 1 + right, first : first + len(found)] = found
                shares[1 - down, 1 - right, other : other + len(found)] = found

        def exchange(first: int, around: list = around, inner: list = inner) -> None:
            part = np.s_[..., first : min(first + _PIXELS, layout.size)]
            _exchange(shares[part], *(layer[part] for layer in (*around[:2], *inner)))

        map_silent(share, range(0, layout.size, _PIXELS))
        map_silent(exchange, range(0, layout.size, _PIXELS))
        now, after = after, now
    return layout.image(now[0])


class _Layout:
    """Images (C, H, W) as (C, margin + H * pitch + margin). After each row is a gap as wide as the largest distance."""

    def __init__(self, height: int, width: int):
        self.height, self.width, self.pitch = height, width, width + max(DISTANCES)
        self.size = height * self.pitch
        self.margin = self.offset(1, 1, max(DISTANCES))

    def offset(self, down: int, right: int, distance: int) -> int:
        return distance * (down * self.pitch + right)

    def laid(self, planes: np.ndarray, gap: float) -> np.ndarray:
        flat = np.full((len(planes), self.size + 2 * self.margin), gap, np.float32)
        self.image(flat)[...] = planes
        return flat

    def image(self, flat: np.ndarray) -> np.ndarray:
        rows = flat[:, self.margin : self.margin + self.size]
        return rows.reshape(len(flat), self.height, self.pitch)[..., : self.width]

    def around(self, flat: np.ndarray, distance: int) -> np.ndarray:
        """(3, 3, C, size): each pixel, in the middle, and its eight neighbours at that distance."""
        corner = flat[:, self.margin - self.offset(1, 1, distance) :]
        down, right = (flat.itemsize * self.offset(*step, distance) for step in ((1, 0), (0, 1)))
        return np.lib.stride_tricks.as_strided(corner, (3, 3, len(flat), self.size), (down, right, *flat.strides))


def _shares(light: np.ndarray, variance: np.ndarray, surface: np.ndarray, floor: np.float32):
    """For each of ``NEIGHBOURS``, the share of light that each pixel exchanges with it, (pixels).

    The arrays are (3, 3, ..., pixels), as ``_Layout.around`` makes them.
    """
    steps = np.empty(surface.shape[2:], np.float32)
    change = np.empty(light.shape[2:], np.float32)
    apart, noise = np.empty((2, light.shape[-1]), np.float32)
    for down, right, weight in NEIGHBOURS:
        there = 1 + down, 1 + right
        np.subtract(light[there], light[1, 1], out=change)
        np.einsum("np,np->p", change, change, out=apart)
        np.add(variance[there][0], variance[1, 1, 0], out=noise)
        apart *= np.float32(1 / len(change))
        apart -= noise
        np.maximum(apart, 0, out=apart)
        noise *= np.float32(SIGNIFICANT**2)
        noise += floor
        apart /= noise
        np.subtract(surface[there], surface[1, 1], out=steps)
        apart += np.einsum("np,np->p", steps, steps, out=noise)
        np.negative(apart, out=apart)
        np.maximum(apart, -SMALLEST, out=apart)
        np.exp(apart, out=apart)
        apart -= _LEAST
        apart *= np.float32(weight)
        yield apart


def _exchange(
    shares: np.ndarray, light: np.ndarray, variance: np.ndarray, next_light: np.ndarray, next_variance: np.ndarray
) -> None:
    """Writes the sums of light and variance over 3x3 pixels, weighted by ``shares``, into the last two arguments.

    Sums are (C, pixels), the other arrays (3, 3, ..., pixels). ``shares`` are overwritten by their squares, which are
    the weights of the variance.
    """
    shares[1, 1] = 0
    np.subtract(1, np.add.reduce(shares, axis=(0, 1)), out=shares[1, 1])
    _sum(shares, light, next_light)
    shares *= shares
    _sum(shares, variance, next_variance)


def _sum(weights: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    # Column by column: at distance 1 the axis of columns has the same stride as the axis of pixels, so einsum would use
    # its three values for the inner loop.
    left, middle, right = (np.einsum("ip,icp->cp", weights[:, i], values[:, i]) for i in range(3))
    np.add(left, middle, out=out)
    out += right
