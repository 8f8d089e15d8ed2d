"""Sums of the inputs of denoisers over the K x K subpixels of each pixel.

The position of a sample in its pixel determines its subpixel. The default points are spread evenly over a pixel: each
subpixel gets the same number of samples if the number of samples per pixel is a multiple of K².
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film.moments import Strands
from ngpt.subpixels import FINE, stored

# Per strand and subpixel: a count and double sums of 3 channels, for each of ``FINE``, and for ``caustic``
BYTES = 3 * (4 + 3 * 8)
BYTES_OF_CAUSTIC = 4 + 3 * 8
# The values under these names are summed. Values of ``primal`` do not include the light of ``caustic``.
SUMMED = (*FINE, "caustic")


class Celled(Protocol):
    """Samples whose places in their pixels are known, such as ``data_gen.paths.camera.CameraSamples``."""

    def cells(self, k: int) -> mi.UInt32:
        """The number of each sample's subpixel among the K x K subpixels of its pixel, row by row."""


@dataclass
class Subpixels:
    """Sums over the samples of each subpixel, for films of ``pixels`` pixels, each in several ``strands``.

    Subpixel c of strand s of pixel p has number (s * pixels + p) * K² + c, and c counts row by row.
    """

    pixels: int
    strands: int
    k: int
    sums: dict[str, list] = field(default_factory=dict)
    counts: dict[str, mi.UInt32] = field(default_factory=dict)

    def add(self, values: dict, cell: mi.UInt32, strands: Strands, place: mi.UInt32) -> None:
        """Adds the samples of a pass, in the order of their strands; ``cell`` is the subpixel of each sample.

        ``place`` is the number of each of the ``strands`` in the film. Samples that are not finite are left out.
        """
        for name in SUMMED:
            if name in values:
                self._add(name, *values[name], cell=cell, strands=strands, place=place)

    def _add(self, name: str, components: list, active, *, cell: mi.UInt32, strands: Strands, place: mi.UInt32) -> None:
        Float64 = dr.float64_array_t(mi.Float)
        cells = self.k * self.k
        if name not in self.sums:
            width = self.pixels * self.strands * cells
            self.sums[name] = [dr.zeros(Float64, width) for _ in components]
            self.counts[name] = dr.zeros(mi.UInt32, width)
            dr.make_opaque(self.sums[name], self.counts[name])
        sums, counts, first = self.sums[name], self.counts[name], place * dr.opaque(mi.UInt32, cells)

        def one(i: mi.UInt32, n: mi.UInt32):
            x = [dr.gather(mi.Float, component, i) for component in components]
            good = dr.all([dr.isfinite(component) for component in x])
            if active is not True:
                good &= dr.gather(mi.Bool, active, i)
            to = first + dr.gather(mi.UInt32, cell, i)
            # No two strands share a subpixel, and a strand takes its samples one by one: the order of additions is
            # fixed.
            how = {"active": good, "mode": dr.ReduceMode.NoConflicts}
            for target, component in zip(sums, x, strict=True):
                dr.scatter_add(target, Float64(component), to, **how)
            dr.scatter_add(counts, mi.UInt32(1), to, **how)
            last = n + 1 == strands.block
            return i + dr.select(last, strands.stride - strands.block + 1, 1), dr.select(last, 0, n + 1)

        state = (mi.UInt32(strands.first), mi.UInt32(0))
        dr.eval(dr.while_loop(state, lambda i, n: i < strands.end, one, label="subpixels"), sums, counts)

    def develop(self, width: int, height: int) -> dict[str, np.ndarray]:
        """The layers of ``FINE``, without layers that have no values, (K H, K W, 3) float32.

        A subpixel without a sample gets the mean of the pixel's other subpixels. If a pixel has no sample, its
        subpixels are NaN.
        """
        found = {name: self._means(name) for name in self.sums}
        if "caustic" in found:
            found["primal"] = found["primal"] + found.pop("caustic")
        k = self.k
        layers = {}
        for name, mean in found.items():
            image = mean.reshape(height, width, k, k, -1).swapaxes(1, 2).reshape(k * height, k * width, -1)
            layers[name] = stored(name, image)
        return layers

    def _means(self, name: str) -> np.ndarray:
        """The means of the subpixels, (pixels, K², 3) in double precision."""
        shape = self.strands, self.pixels, self.k * self.k
        count = np.array(self.counts[name], np.int64).reshape(shape).sum(axis=0)
        sums = [np.array(channel).reshape(shape).sum(axis=0) for channel in self.sums[name]]
        empty = count == 0
        with np.errstate(invalid="ignore"):
            mean = np.stack(sums, axis=-1) / np.maximum(count, 1)[..., None]
            if empty.any():
                others = mean.sum(axis=1, keepdims=True) / (~empty).sum(axis=1)[:, None, None]
                mean = np.where(empty[..., None], others, mean)
        return mean


def bytes_of_subpixels(k: int, caustic: bool) -> int:
    """Bytes of a strand for K x K subpixels; ``caustic``: whether light may be put under that name."""
    return k * k * (BYTES + (BYTES_OF_CAUSTIC if caustic else 0)) if k > 1 else 0
