"""Per-pixel statistics of gradient samples, gathered over several passes in constant memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import claims
from data_gen.film.moments import Moments, Strands, accumulate, no_moments, one_more, put_back, taken
from data_gen.film.splats import SPLAT_BYTES, Splats
from data_gen.film.statistics import contrast, statistics
from data_gen.film.subpixels import Celled, Subpixels, bytes_of_subpixels
from ngpt.layers import DIFFERENCES, FEATURE_NOISE
from ngpt.shared import shared_variance
from ngpt.stack import GradientStack
from ngpt.subpixels import SUBPIXELS, means
from ngpt.windows import Place

# The shifts of samplers, (x, y) in pixels, y down: forward ("+") and backward ("-") for each layer of differences. The
# film keeps the differences "neighbour - base" at the base pixel and combines both directions when it develops.
SHIFTS = {
    f"{layer}{sign}": (factor * x, factor * y)
    for layer, (x, y, _) in DIFFERENCES.items()
    for sign, factor in (("+", 1), ("-", -1))
}

# Values under these names become diagnostic images and not layers of the stack: name -> name of the image
DIAGNOSTICS = {"shift_failures": "diagnostics.shiftFailures"}
DISCARDED = "diagnostics.discarded"

# Parts of the primal, by the lobe of the first scattering event
_SPLIT = ("diffuse", "specular")
# Features whose noise is summarised by one number, see ``GradientFilm.feature_noise``
_FEATURES = ("albedo", "normal")
_WITH_VARIANCE = frozenset({"primal", "caustic", *_SPLIT, *SHIFTS, *_FEATURES})
# Bytes per strand (a pixel's samples are summed in one or more strands): two counts for each of 10 names, double means
# of 26 channels and sums of squares of 21; and a second copy of the moments of one name, while they are updated.
_STRAND_BYTES = 10 * 8 + (26 + 21) * 8 + (8 + 6 * 8)
# Without gradients: 5 names, 13 channels, 9 sums of squares. This leaves memory for more subpixels.
_STRAND_BYTES_WITHOUT = 5 * 8 + (13 + 9) * 8 + (8 + 6 * 8)
# Per strand, for the layer ``shared``, which few films have: two counts, double means
_SHARED_BYTES = 8 + 3 * 8
# Per strand, for the two sets of ``moments.Earlier``: float32 means of 21 channels; and for each of their seven names
# two counts and the number of bits
_HALVES_BYTES = 2 * 21 * 4 + 7 * 3 * 4
_HALVES_BYTES_WITHOUT = 2 * 9 * 4 + 3 * 3 * 4
# Per pixel, for one name, in a pass that is one batch: the mean over the batch, the splats and their sums.
_BATCH_BYTES = 3 * 8 + 3 * SPLAT_BYTES + 4 + 3 * 8
# Enough pixels to estimate the mean noise of features
_ENOUGH = 1 << 13
# With fewer pixels than this, several strands of samples share a pixel: a few long loops would leave cores idle.
_STRANDS = 1 << 15


class GradientFilm:
    """Collects samples, in the order of ``CameraSamples``, and develops them into the layers of a gradient stack.

    Samples that are not finite get zero weight: they are left out of the mean and counted. The number of a sample
    determines which sum it is added to, and in what order. So the same samples give the same bits, however they are
    divided into passes.

    A pass may hold samples of only ``some`` pixels. Then pixels differ in their number of samples, and so may the two
    pixels of a difference. Each direction of a difference is a mean over the base paths of its own pixel.

    Variances are computed over samples, as if these were independent. A ``net`` above 0 says that samples are points of
    rounds, and that the first round has ``net`` points per pixel. Then the variances are scaled to the observed noise,
    see ``data_gen.film.claims``. If samples of a pass share photons, reservoirs or the state of a chain, or lanes splat
    onto other pixels, the film is made with ``batches``. Then each pass is one batch, a pixel's value is its mean over
    the batch, and variances are computed over batches. Batches are weighted by their number of samples, since the last
    one may have fewer.

    With ``subpixels`` K > 1 the film also keeps the inputs of denoisers for the K x K subpixels of each pixel
    (``ngpt.subpixels``). Then ``begin_pass`` must be called before each pass. Batches have no subpixels.

    ``bytes`` is the most memory that the film takes. It is less without ``gradients``.
    """

    def __init__(
        self,
        width: int,
        height: int,
        batches: bool = False,
        net: int = 0,
        subpixels: int = 1,
        gradients: bool = True,
    ):
        self.width, self.height, self.batches, self.net = width, height, batches, net
        self.pixels = width * height
        self.strands = 1 if batches else max(1, _STRANDS // self.pixels)
        self.samples = 0  # per pixel; only for pixels that were in all passes
        self.blocks = 0  # blocks of samples; each block goes to one strand
        self.batch = 0  # samples per pixel of all batches but the last, which may have fewer
        # Samples of each pixel, where these may differ
        self.counts: np.ndarray | None = None
        self._blocks_each = np.zeros(0, np.int64)
        # Dr.Jit gives each array the next power of two of bytes.
        own, halves = (_STRAND_BYTES, _HALVES_BYTES) if gradients else (_STRAND_BYTES_WITHOUT, _HALVES_BYTES_WITHOUT)
        bytes_each = own + (_BATCH_BYTES if batches else 0) + (halves if net else 0)
        bytes_each += bytes_of_subpixels(subpixels, caustic=gradients)
        self.bytes = bytes_each * (1 << (self.pixels * self.strands - 1).bit_length())
        self.subpixels = subpixels
        self._fine = Subpixels(self.pixels, self.strands, subpixels) if subpixels > 1 else None
        self._cell: mi.UInt32 | None = None
        self.moments: dict[str, Moments] = {}
        self._pass: dict[str, tuple] = {}
        self._splats: dict[str, Splats] = {}

    def begin_pass(self, camera: Celled) -> None:
        """Records the subpixel of each sample of the next pass, if the film has subpixels."""
        if self._fine:
            self._cell = camera.cells(self.subpixels)

    def put(self, name: str, value, active: bool | mi.Bool = True) -> None:
        """Adds the samples of one pass.

        ``value`` is a Float or Color3f with ``width * height * spp`` lanes, and ``active`` says which of them exist (an
        offset outside the image does not). A second value under the same name begins the next pass.
        """
        if name in self._pass:
            self.end_pass()
        self._pass[name] = (_components(value), active)

    def put_all(self, values: dict) -> None:
        """``put`` for several values: name -> samples, or (samples, which of them exist)."""
        for name, value in values.items():
            self.put(name, *(value if isinstance(value, tuple) else (value,)))

    def splat(self, name: str, pixel: mi.UInt32, value, active: bool | mi.Bool = True) -> None:
        """Adds each lane's value to any ``pixel``, numbered row by row. Only films with ``batches`` allow it.

        In a pass with n samples per pixel, a pixel's value is the mean of the values put for it, plus the sum of its
        splats divided by n. So a lane's splat has the same weight as the value that the lane puts. With one light path
        per camera sample, a splat is the light path's contribution to the pixel divided by its density. Several splats
        of a name in a pass add up.
        """
        components = _components(value)
        self.splats(name, len(components)).add(pixel, components, mi.Bool(active))

    def splats(self, name: str, channels: int = 3) -> Splats:
        """The splats of a name in this pass. Their ``add`` may be called within symbolic loops."""
        if not self.batches:
            raise ValueError("splats are not independent samples: make the film with batches")
        if name not in self._splats:
            self._splats[name] = Splats(self.pixels, channels)
        return self._splats[name]

    def end_pass(self, block: int | None = None, some: np.ndarray | None = None) -> None:
        """Adds the values of the pass to the statistics, all at once: an interrupted pass leaves no trace.

        ``block`` is the ``block`` of ``CameraSamples``: the number of samples of a pixel that are side by side. In a
        film with ``batches`` it is the number of samples per pixel in the pass, and must be given if there are only
        splats. If the pass does not treat all pixels alike, ``some`` is the pixel of each block, ascending. All later
        passes must then give ``some`` too.
        """
        if not self._pass and not self._splats:
            return
        values, self._pass = self._pass, {}
        splats, self._splats = self._splats, {}
        cell, self._cell = self._cell, None
        if self._fine and cell is None:
            raise ValueError("a film with subpixels needs begin_pass() before each pass")
        # Reading single lanes evaluates an array: without this, each read would trace the paths again.
        dr.eval(values, cell)
        if some is not None:
            self._add_some(values, block, some, cell)
            return
        if self.counts is not None:
            raise ValueError("pixels differ in their number of samples: give the pixel of each block in `some`")
        lanes = dr.width(values) if values else self.pixels * (block or 0)
        spp = lanes // self.pixels
        block = block or spp
        if self.batches:
            self._add_batch(values, splats, spp)
        else:
            # Block b goes to strand b mod strands.
            pixel, pixels = dr.arange(mi.UInt32, self.pixels * self.strands), opaque(self.pixels)
            strand, pixel = pixel // pixels, pixel % pixels
            behind = opaque(self.strands - self.blocks % self.strands)
            turn = (strand + behind) % opaque(self.strands)
            first, number = (turn * pixels + pixel) * opaque(block), turn * opaque(block) + opaque(self.samples)
            dr.eval(first, number)
            stride, further = opaque(self.strands * self.pixels * block), opaque(self.strands * block)
            strands = Strands(first, opaque(lanes), opaque(block), stride, number, further)
            for name, (components, active) in values.items():
                new = accumulate(self._moments(name, len(components)), components, active, strands)
                # Evaluated one by one, since the old and the new moments of a name are in memory together.
                dr.eval(new)
                self.moments[name] = new
            if self._fine:
                self._fine.add(values, cell, strands, dr.arange(mi.UInt32, self.pixels * self.strands))
        self.samples += spp
        self.blocks += spp // block

    def forget_pass(self) -> None:
        """Drops the values of the current pass, because it was aborted."""
        self._pass, self._splats, self._cell = {}, {}, None

    def _add_some(self, values: dict, block: int | None, some: np.ndarray, cell: mi.UInt32 | None) -> None:
        """Adds the samples of a pass whose blocks belong to ``some`` pixels."""
        if self.batches or not block:
            raise ValueError("a pass of some pixels needs blocks of independent samples: no batches, and a block size")
        if self.counts is None:
            self.counts = np.full(self.pixels, self.samples, np.int64)
            self._blocks_each = np.full(self.pixels, self.blocks, np.int64)
        pixels, starts, blocks = np.unique(some, return_index=True, return_counts=True)
        job = dr.arange(mi.UInt32, len(pixels) * self.strands)
        strand, i = job // len(pixels), job % len(pixels)

        def of_job(numbers: np.ndarray) -> mi.UInt32:
            return dr.gather(mi.UInt32, mi.UInt32(numbers), i)

        # As in passes of all pixels, block b of a pixel goes to strand b mod strands.
        behind = of_job(self.strands - self._blocks_each[pixels] % self.strands)
        turn = (strand + behind) % self.strands
        first, number = ((of_job(n) + turn) * opaque(block) for n in (starts, self._blocks_each[pixels]))
        end, place = of_job((starts + blocks) * block), strand * self.pixels + of_job(pixels)
        dr.eval(first, number, end, place)
        further = opaque(self.strands * block)
        strands = Strands(first, end, opaque(block), further, number, further)
        for name, (components, active) in values.items():
            old = self._moments(name, len(components))
            new = accumulate(taken(old, place), components, active, strands)
            dr.eval(new)
            self.moments[name] = put_back(old, new, place)
        if self._fine:
            self._fine.add(values, cell, strands, place)
        self.counts[pixels] += blocks * block
        self._blocks_each[pixels] += blocks

    def _add_batch(self, values: dict, splats: dict, spp: int) -> None:
        """Adds one more value for each pixel and name: the mean over the pass, splats included."""
        self.batch = self.batch or spp
        if spp > self.batch:
            raise ValueError(f"a batch of {spp} samples after batches of {self.batch}: only the last may be smaller")
        first = dr.arange(mi.UInt32, self.pixels) * opaque(spp)
        strands = Strands(first, first + opaque(spp), opaque(spp), opaque(spp), opaque(0), opaque(spp))
        for name in dict.fromkeys((*values, *splats)):
            mean, exists, lost = None, mi.Bool(True), mi.UInt32(0)
            if name in values:
                components, active = values[name]
                batch = accumulate(no_moments(self.pixels, len(components), False), components, active, strands)
                mean, exists, lost = batch.mean, batch.count > 0, batch.lost
            if name in splats:
                sums, lost_splats = splats[name].totals(), splats[name].lost
                share = dr.opaque(dr.float64_array_t(mi.Float), 1 / spp)
                # If nothing was put, the value is the sum of the splats. If all values that were put are lost, the
                # pixel is unknown.
                mean = [(m if mean else 0) + s * share for m, s in zip(mean or sums, sums, strict=True)]
                lost = lost + lost_splats
            number = opaque(self.blocks) + dr.zeros(mi.UInt32, self.pixels)
            moments = one_more(self._moments(name, len(mean)), mean, exists, number, opaque(spp))
            moments.lost += lost
            dr.eval(moments)
            self.moments[name] = moments

    @property
    def samples_each(self) -> np.ndarray:
        """Samples of each pixel, (pixels) int64, including samples that were not finite."""
        return np.full(self.pixels, self.samples, np.int64) if self.counts is None else self.counts.copy()

    def _moments(self, name: str, channels: int) -> Moments:
        """The statistics so far of the values put under a name."""
        width = self.pixels * self.strands
        variance = name in _WITH_VARIANCE
        return self.moments.get(name) or no_moments(width, channels, variance, variance and self.net > 0)

    @property
    def discarded(self) -> int:
        """How many values were left out because they were not finite."""
        self.end_pass()
        return sum(int(np.array(moments.lost, np.int64).sum()) for moments in self.moments.values())

    def develop(self) -> dict[str, np.ndarray]:
        """The layers, (H, W, C) float32: the means of all values put, dx and dy from the shifts, and their variances.

        Variances are variances of the pixel mean. They are left out while no pixel has more than one sample. A pixel
        that lost all its samples is NaN. There is a layer ``samples`` if pixels differ in their number of samples.
        """
        self.end_pass()
        layers = {}
        for name in self.moments:
            if name not in SHIFTS and name not in DIAGNOSTICS:
                layers[name] = self._image(self._statistics(name)[1])
        count = self._statistics("primal")[0]
        variances = {"primal_var": self._claimed("primal")}
        if "caustic" in layers:
            # Samplers put ``caustic`` beside a primal that lacks it. The variance of that primal goes with dx and dy.
            layers["primal"] = layers["primal"] + layers["caustic"]
            variances["caustic_var"] = self._claimed("caustic")
        if "shared" in layers:
            if layers["shared"].any():
                variances["primal_var"] = variances["primal_var"] + shared_variance(layers["shared"])
            else:  # paths were allowed to share their tails, but no path did
                del layers["shared"]
        for layer in _SPLIT:
            if layer in layers:
                variances[f"{layer}_var"] = self._claimed(layer)
        for layer in DIFFERENCES:
            if f"{layer}+" in self.moments:
                layers[layer], variances[f"{layer}_var"] = self._gradient(layer)
        if np.max(count) > 1:
            layers |= variances
        if self.counts is not None and np.ptp(self.counts):
            layers["samples"] = self._image(self.counts)
        return {name: np.ascontiguousarray(layer, np.float32) for name, layer in layers.items()}

    def stack(self, attributes: Mapping[str, Any] | None = None, place: Place | None = None) -> GradientStack:
        """The layers as a stack, with further ``attributes``, at a ``place`` in a larger picture."""
        known = {"ngpt:spp": int(self.samples_each.mean()), "ngpt:normalSpace": "camera"}
        if (noise := self.feature_noise) is not None:
            known[FEATURE_NOISE] = noise
        where = {} if place is None else {"place": place}
        layers, fine = self.develop(), {}
        if self._fine:
            known[SUBPIXELS] = self.subpixels
            fine = self._fine.develop(self.width, self.height)
            layers |= {name: means(layer, self.subpixels) for name, layer in fine.items()}
        return GradientStack(layers, known | dict(attributes or {}), fine=fine, **where)

    @property
    def feature_noise(self) -> float | None:
        """The variance of the pixel mean of ``albedo`` or ``normal``, whichever is larger. Each is a mean over channels
        and pixels; large images use a subset of their pixels. None if there are no features, or no pixel has more than
        one sample.
        """
        self.end_pass()
        some = np.arange(0, self.pixels, -(-self.pixels // _ENOUGH))
        place = mi.UInt32((np.arange(self.strands)[:, None] * self.pixels + some).ravel())
        found = []
        for name in _FEATURES:
            if name in self.moments:
                moments = taken(self.moments[name], place) if len(some) < self.pixels else self.moments[name]
                dr.eval(moments)
                variance = statistics(moments, self.strands, self.batch)[2]
                if self.net:
                    seen = contrast(moments, self.strands, self._numbers[some])
                    variance = variance * claims.factor(seen, variance, self._numbers[some], self._net_of_numbers)
                if np.isfinite(variance).any():
                    found.append(float(np.nanmean(variance)))
        return max(found, default=None)

    def diagnose(self) -> dict[str, np.ndarray]:
        """Diagnostic images, (H, W) float32 in [0, 1]: the means of the values put under the names of ``DIAGNOSTICS``,
        and the share of a pixel's values that were left out because they were not finite."""
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

    def known(self, name: str) -> tuple[np.ndarray, np.ndarray | None]:
        """The mean of the values put under a name, and the sample variance of that mean or None, each (H, W, C)."""
        _, mean, variance = self._statistics(name)
        return self._image(mean), None if variance is None else self._image(variance)

    def _statistics(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        return statistics(self.moments[name], self.strands, self.batch)

    def _gradient(self, layer: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns one difference, the mean of its two directions (survey, Algorithm 1), and its variance.

        The difference between pixel p and its successor is sampled from p by the forward shift and, independently, from
        the successor by the backward shift. Each direction estimates its own part of the difference. So if one pixel
        has more samples, its part has less variance, but not more weight. If only the forward shift has values, these
        are the whole difference.
        """
        x, y = SHIFTS[f"{layer}+"]
        behind, ahead = np.s_[: self.height - y, : self.width - x], np.s_[y:, x:]
        gradient = np.zeros((self.height, self.width, 3))
        variance = np.zeros((self.height, self.width, 3))
        _, one, one_var = self._statistics(f"{layer}+")
        if f"{layer}-" not in self.moments:
            gradient[behind], variance[behind] = self._image(one)[behind], self._image(one_var)[behind]
            return gradient, self._as_seen(variance, [(f"{layer}+", behind, 1.0)])
        _, other, other_var = self._statistics(f"{layer}-")
        gradient[behind] = 0.5 * (self._image(one)[behind] - self._image(other)[ahead])
        variance[behind] = 0.25 * (self._image(one_var)[behind] + self._image(other_var)[ahead])
        return gradient, self._as_seen(variance, [(f"{layer}+", behind, 0.5), (f"{layer}-", ahead, -0.5)])

    def _claimed(self, name: str) -> np.ndarray:
        """The variance of the pixel mean of the values put under a name."""
        return self._as_seen(self._image(self._statistics(name)[2]), [(name, np.s_[:, :], 1.0)])

    def _as_seen(self, variance: np.ndarray, terms: list[tuple[str, tuple, float]]) -> np.ndarray:
        """Scales a sample ``variance`` (H, W, 3) to the observed noise, if samples are points of nets. It is the
        variance of a sum of ``terms``: (name, which pixels, factor)."""
        if not self.net:
            return variance
        contrasts = {name: contrast(self.moments[name], self.strands, self._numbers) for name, _, _ in terms}
        seen = sum(factor * self._image(contrasts[name])[pixels] for name, pixels, factor in terms)
        where = terms[0][1]
        claimed = variance.copy()
        samples = self._image(self._numbers)[where][..., 0]
        claimed[where] *= claims.factors(seen, variance[where], samples, self._net_of_numbers)
        return claimed

    @property
    def _numbers(self) -> np.ndarray:
        """The number of values behind the variance of each pixel, (pixels): samples, or batches."""
        return np.full(self.pixels, self.blocks) if self.batches else self.samples_each

    @property
    def _net_of_numbers(self) -> int:
        """The number of values in the first round, a power of two. With batches, a value is the mean of a block of
        points."""
        net = self.net // self.batch if self.batches else self.net
        return 1 << max(net.bit_length() - 1, 0)

    def _image(self, columns: np.ndarray) -> np.ndarray:
        return columns.reshape(self.height, self.width, -1)


def bytes_of_shared(pixels: int) -> int:
    """The bytes that the layer ``shared`` takes for this number of pixels."""
    return _SHARED_BYTES * (1 << (max(pixels, _STRANDS) - 1).bit_length())


def _components(value) -> list:
    """The channels of a Float or a colour."""
    return [value] if isinstance(value, mi.Float) else list(value)


def opaque(n: int) -> mi.UInt32:
    """A new variable that holds ``n``, so that the number is not compiled into kernels."""
    return dr.opaque(mi.UInt32, n)
