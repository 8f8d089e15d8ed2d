"""Per-pixel statistics of gradient samples, gathered over several passes in constant memory."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

# The four neighbours of a base pixel, as offsets (x, y) in pixels, y down. The film keeps the differences
# "neighbour - base" at the base pixel and combines both sides afterwards, so no sample is ever splatted.
SHIFTS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}


class Moments:
    """Running mean and variance per pixel, merged pass by pass in double precision.

    Chan, Golub, LeVeque 1983, "Algorithms for computing the sample variance", eq. 2.1. Sums of squares would lose all
    digits where the variance is small beside the mean.
    """

    def __init__(self, pixels: int, channels: int):
        self.count = np.zeros((pixels, 1))
        self.mean = np.zeros((pixels, channels))
        self.m2 = np.zeros((pixels, channels))

    def merge(self, count: np.ndarray, mean: np.ndarray, m2: np.ndarray) -> None:
        """Adds a batch: ``count`` (pixels, 1) samples with their mean and sum of squared deviations (pixels, C)."""
        total = self.count + count
        share = np.divide(count, total, out=np.zeros_like(total), where=total > 0)
        delta = mean - self.mean
        self.mean += delta * share
        self.m2 += m2 + delta**2 * self.count * share
        self.count = total

    def mean_or_nan(self) -> np.ndarray:
        """The mean, NaN where a pixel has no sample: unknown must not look like zero."""
        return np.where(self.count > 0, self.mean, np.nan)

    def variance_of_mean(self) -> np.ndarray:
        """Sample variance divided by the number of samples; NaN where a pixel has fewer than two."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.count > 1, self.m2 / (self.count - 1) / self.count, np.nan)


class GradientFilm:
    """Collects samples, in lanes ordered pixel by pixel, and develops them into the layers of a gradient stack.

    Samples that are not finite get zero weight: they are left out of the mean and counted in ``discarded``.
    """

    def __init__(self, width: int, height: int):
        self.width, self.height = width, height
        self.moments: dict[str, Moments] = {}
        self.discarded = 0

    def put(self, name: str, value, active: bool | mi.Bool = True) -> None:
        """Adds one pass of samples.

        ``value`` is a Float or Color3f with ``width * height * k`` lanes, those of a pixel next to each other, and
        ``active`` says which of them exist (an offset outside the image does not).
        """
        lanes = dr.width(value)
        pixels = self.width * self.height
        per_pixel = lanes // pixels
        # Block sums evaluate their argument: without this, each would trace the paths again.
        dr.eval(value, active)
        components = [value] if isinstance(value, mi.Float) else list(value)
        finite = mi.Bool(True)
        for component in components:
            finite &= dr.isfinite(component)
        good = dr.full(mi.Bool, True, lanes) & finite & active
        count = dr.block_sum(dr.select(good, mi.Float(1), 0), per_pixel)
        discarded = dr.count(~finite & active & dr.full(mi.Bool, True, lanes))
        means, m2s = [], []
        for component in components:
            # Two steps, mean first: block sums are deterministic, which atomic scatters into a film are not.
            mean = dr.block_sum(dr.select(good, component, 0), per_pixel) / dr.fmax(count, 1)
            deviation = dr.select(good, component - dr.repeat(mean, per_pixel), 0)
            means.append(mean)
            m2s.append(dr.block_sum(dr.square(deviation), per_pixel))
        dr.eval(count, means, m2s, discarded)
        self.discarded += int(discarded[0])
        columns = [np.stack([np.array(c, np.float64) for c in group], axis=-1) for group in (means, m2s)]
        if name not in self.moments:
            self.moments[name] = Moments(pixels, len(components))
        self.moments[name].merge(np.array(count, np.float64)[:, None], *columns)

    def put_all(self, values: dict) -> None:
        """``put`` for values that come out of one kernel: name -> samples."""
        dr.eval(values)
        for name, value in values.items():
            self.put(name, value)

    def develop(self) -> dict[str, np.ndarray]:
        """The layers, (H, W, C) float32: means of all that was put, dx, dy of the shifts, and their variances.

        Variances are of the pixel mean and left out while a pixel has a single sample. A pixel that lost all its
        samples is NaN.
        """
        layers = {}
        for name, moments in self.moments.items():
            if name not in SHIFTS:
                layers[name] = self._image(moments.mean_or_nan())
        variances = {"primal_var": self._image(self.moments["primal"].variance_of_mean())}
        for layer, forward, backward, axis in (("dx", "right", "left", 1), ("dy", "down", "up", 0)):
            if forward in self.moments:
                layers[layer], variances[f"{layer}_var"] = self._gradient(forward, backward, axis)
        if np.max(self.moments["primal"].count) > 1:
            layers |= variances
        return {name: np.ascontiguousarray(layer, np.float32) for name, layer in layers.items()}

    def _gradient(self, forward: str, backward: str, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Both directions of one difference, each with weight 1/2 (survey, Algorithm 1), and the variance of that.

        The difference between pixel p and its successor is sampled from p by the forward shift and, independently,
        from the successor by the backward shift.
        """
        ahead = np.s_[:, 1:] if axis == 1 else np.s_[1:]
        behind = np.s_[:, :-1] if axis == 1 else np.s_[:-1]
        gradient = np.zeros((self.height, self.width, 3))
        variance = np.zeros((self.height, self.width, 3))
        one, other = self.moments[forward], self.moments[backward]
        gradient[behind] = 0.5 * (self._image(one.mean_or_nan())[behind] - self._image(other.mean_or_nan())[ahead])
        variance[behind] = 0.25 * (
            self._image(one.variance_of_mean())[behind] + self._image(other.variance_of_mean())[ahead]
        )
        return gradient, variance

    def _image(self, columns: np.ndarray) -> np.ndarray:
        return columns.reshape(self.height, self.width, -1)
