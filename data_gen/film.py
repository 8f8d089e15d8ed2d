"""Per-pixel statistics of gradient samples, gathered over several passes in constant memory."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

# The four neighbours of a base pixel, as offsets (x, y) in pixels, y down. The film keeps the differences
# "neighbour - base" at the base pixel and combines both sides afterwards, so no sample is ever splatted.
SHIFTS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}

# What is put under these names becomes a diagnostic image, not a layer of the stack: name -> name of the image.
DIAGNOSTICS = {"shift_failures": "diagnostics.shiftFailures"}
DISCARDED = "diagnostics.discarded"

_WITH_VARIANCE = frozenset({"primal", *SHIFTS})
# Per strand: two counts for each of 10 names, double means of 26 channels and sums of squares of 15; and the moments of
# one name once more.
_STRAND_BYTES = 10 * 8 + (26 + 15) * 8 + (8 + 6 * 8)
# With fewer pixels than this, several strands of samples share a pixel: a few long loops would leave cores idle.
_STRANDS = 1 << 15


@dataclass
class Moments:
    """Running statistics of one value, for all strands: counts UInt32, a Float64 for each channel of the others."""

    count: mi.UInt32  # samples that count
    lost: mi.UInt32  # samples left out because they were not finite
    mean: list
    m2: list  # sum of squared deviations from the mean; empty where nobody asks for a variance


class GradientFilm:
    """Collects samples, in the order of ``CameraSamples``, and develops them into the layers of a gradient stack.

    Samples that are not finite get zero weight: they are left out of the mean and counted. Which sample is added to
    which sum, and in what order, depends on its number alone: the same samples give the same bits, whatever the passes.
    """

    def __init__(self, width: int, height: int):
        self.width, self.height = width, height
        self.pixels = width * height
        self.strands = max(1, _STRANDS // self.pixels)
        self.samples = 0  # per pixel
        self.blocks = 0  # of samples, each of which goes to one strand
        # Dr.Jit gives each array the next power of two of bytes.
        self.bytes = _STRAND_BYTES * (1 << (self.pixels * self.strands - 1).bit_length())
        self.moments: dict[str, Moments] = {}
        self._pass: dict[str, tuple] = {}

    def put(self, name: str, value, active: bool | mi.Bool = True) -> None:
        """Adds the samples of one pass.

        ``value`` is a Float or Color3f with ``width * height * spp`` lanes, and ``active`` says which of them exist (an
        offset outside the image does not). What is put under one name again belongs to the next pass.
        """
        if name in self._pass:
            self.end_pass()
        components = [value] if isinstance(value, mi.Float) else list(value)
        self._pass[name] = (components, active)

    def put_all(self, values: dict) -> None:
        """``put`` for several values: name -> samples."""
        for name, value in values.items():
            self.put(name, value)

    def end_pass(self, block: int | None = None) -> None:
        """Adds what was put to the statistics: all of it, so that a pass broken off before leaves no trace.

        ``block`` is that of ``CameraSamples``: the number of samples of a pixel that are side by side.
        """
        if not self._pass:
            return
        values, self._pass = self._pass, {}
        # Reading single lanes evaluates an array: without this, each would trace the paths again.
        dr.eval(values)
        lanes = dr.width(values)
        spp = lanes // self.pixels
        block = block or spp
        # Block b goes to strand b mod strands. Opaque: literals would be compiled into the kernel, each anew.
        pixel = dr.arange(mi.UInt32, self.pixels * self.strands)
        strand, pixel = pixel // self.pixels, pixel % self.pixels
        behind = dr.opaque(mi.UInt32, self.strands - self.blocks % self.strands)
        first = ((strand + behind) % self.strands * self.pixels + pixel) * dr.opaque(mi.UInt32, block)
        dr.eval(first)
        where = (first, *(dr.opaque(mi.UInt32, n) for n in (lanes, block, self.strands * self.pixels * block)))
        for name, (components, active) in values.items():
            moments = self.moments.get(name) or self._nothing(len(components), name in _WITH_VARIANCE)
            self.moments[name] = accumulate(moments, components, active, *where)
            # One by one: the old moments and the new ones are in memory together.
            dr.eval(self.moments[name])
        self.samples += spp
        self.blocks += spp // block

    def _nothing(self, channels: int, variance: bool) -> Moments:
        width = self.pixels * self.strands
        Float64 = dr.float64_array_t(mi.Float)
        mean, m2 = ([dr.zeros(Float64, width) for _ in range(channels)] for _ in range(2))
        return Moments(dr.zeros(mi.UInt32, width), dr.zeros(mi.UInt32, width), mean, m2 if variance else [])

    @property
    def discarded(self) -> int:
        """How many values were left out because they were not finite."""
        self.end_pass()
        return sum(int(np.array(moments.lost, np.int64).sum()) for moments in self.moments.values())

    def develop(self) -> dict[str, np.ndarray]:
        """The layers, (H, W, C) float32: means of all that was put, dx, dy of the shifts, and their variances.

        Variances are of the pixel mean and left out while a pixel has a single sample. A pixel that lost all its
        samples is NaN.
        """
        self.end_pass()
        layers = {}
        for name in self.moments:
            if name not in SHIFTS and name not in DIAGNOSTICS:
                layers[name] = self._image(self._statistics(name)[1])
        count, _, variance = self._statistics("primal")
        variances = {"primal_var": self._image(variance)}
        for layer, forward, backward, axis in (("dx", "right", "left", 1), ("dy", "down", "up", 0)):
            if forward in self.moments:
                layers[layer], variances[f"{layer}_var"] = self._gradient(forward, backward, axis)
        if np.max(count) > 1:
            layers |= variances
        return {name: np.ascontiguousarray(layer, np.float32) for name, layer in layers.items()}

    def diagnose(self) -> dict[str, np.ndarray]:
        """Diagnostic images, (H, W) float32 in [0, 1]: the mean of what was put under the names of ``DIAGNOSTICS``, and
        which share of a pixel's values was left out because it was not finite."""
        self.end_pass()
        images = {image: self._statistics(name)[1] for name, image in DIAGNOSTICS.items() if name in self.moments}
        lost, count = (
            sum(np.array(getattr(moments, field), np.int64) for moments in self.moments.values())
            for field in ("lost", "count")
        )
        lost, count = (n.reshape(self.strands, self.pixels).sum(axis=0) for n in (lost, count))
        images[DISCARDED] = lost / np.maximum(lost + count, 1)
        return {
            name: np.ascontiguousarray(np.nan_to_num(image.reshape(self.height, self.width)), np.float32)
            for name, image in images.items()
        }

    def _statistics(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Count (pixels, 1), mean and variance of the mean (pixels, C), of all strands of a pixel together.

        Unknown must not look like zero: the mean of no sample is NaN, and so is the variance of fewer than two. Chan,
        Golub, LeVeque 1983, "Algorithms for computing the sample variance", eq. 2.1.
        """
        moments, shape = self.moments[name], (self.strands, self.pixels)
        counts = np.array(moments.count, np.float64).reshape(shape)
        count = counts.sum(axis=0)
        means, variances = [], []
        with np.errstate(invalid="ignore", divide="ignore"):
            for channel in moments.mean:
                strands = np.array(channel).reshape(shape)
                # 0 / 0 is NaN, as it should be. A single strand keeps its mean to the last bit.
                mean = strands[0] * (count / count) if self.strands == 1 else (counts * strands).sum(axis=0) / count
                means.append(mean)
                if moments.m2:
                    m2 = np.array(moments.m2[len(variances)]).reshape(shape).sum(axis=0)
                    if self.strands > 1:
                        m2 += (counts * np.square(strands - mean)).sum(axis=0)
                    variances.append(np.where(count > 1, m2 / (count - 1) / count, np.nan))
        return count[:, None], np.stack(means, axis=-1), np.stack(variances, axis=-1) if variances else None

    def _gradient(self, forward: str, backward: str, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Both directions of one difference, each with weight 1/2 (survey, Algorithm 1), and the variance of that.

        The difference between pixel p and its successor is sampled from p by the forward shift and, independently,
        from the successor by the backward shift.
        """
        ahead = np.s_[:, 1:] if axis == 1 else np.s_[1:]
        behind = np.s_[:, :-1] if axis == 1 else np.s_[:-1]
        gradient = np.zeros((self.height, self.width, 3))
        variance = np.zeros((self.height, self.width, 3))
        (_, one, one_var), (_, other, other_var) = self._statistics(forward), self._statistics(backward)
        gradient[behind] = 0.5 * (self._image(one)[behind] - self._image(other)[ahead])
        variance[behind] = 0.25 * (self._image(one_var)[behind] + self._image(other_var)[ahead])
        return gradient, variance

    def _image(self, columns: np.ndarray) -> np.ndarray:
        return columns.reshape(self.height, self.width, -1)


def accumulate(moments: Moments, components: list, active, first, end, block, stride) -> Moments:
    """Adds samples to each lane's moments: ``block`` of them from ``first`` on, again from ``first + stride`` on, and
    so forth below ``end``, all UInt32.

    Welford 1962, "Note on a method for calculating corrected sums of squares and products", in double precision: sums
    of squares would lose all digits where the variance is small beside the mean.
    """
    Float64 = dr.float64_array_t(mi.Float)

    def add(i: mi.UInt32, n: mi.UInt32, old: Moments):
        x = [dr.gather(mi.Float, component, i) for component in components]
        exists = mi.Bool(True) if active is True else dr.gather(mi.Bool, active, i)
        finite = dr.all([dr.isfinite(component) for component in x])
        good = exists & finite
        count = dr.select(good, old.count + 1, old.count)
        lost = dr.select(exists & ~finite, old.lost + 1, old.lost)
        share = 1 / Float64(dr.maximum(count, 1))
        deviations = [dr.select(good, Float64(c) - m, 0) for c, m in zip(x, old.mean, strict=True)]
        mean = [dr.fma(d, share, m) for d, m in zip(deviations, old.mean, strict=True)]
        # (x - old mean)(x - new mean), where x - new mean = (x - old mean)(1 - share).
        m2 = [dr.fma(d * d, 1 - share, m) for d, m in zip(deviations, old.m2, strict=False)]
        last = n + 1 == block
        i = i + dr.select(last, stride - block + 1, 1)  # not in place: that would move `first` too
        return i, dr.select(last, 0, n + 1), Moments(count, lost, mean, m2)

    return dr.while_loop((first, mi.UInt32(0), moments), lambda i, *_: i < end, add, label="film")[2]
