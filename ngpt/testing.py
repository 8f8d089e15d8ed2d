"""Statistical tests of renderings, for the tests of ngpt and for authors of samplers.

A sampler is right if its mean is right. A single image and a fixed tolerance cannot show this, but independent renders
of the sampler and of a reference can. The spread of the renders gives standard errors, and the significance level of
each comparison follows from the number of comparisons.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t


@dataclass(frozen=True)
class ZTest:
    """The result of comparing the means of two sets of renders, block by block.

    ``z``        (rows, columns, C) differences of block means in standard errors
    ``p``        two-sided p-values of the same shape
    ``level``    the significance level of each p-value, after Šidák's correction for their number
    """

    z: np.ndarray
    p: np.ndarray
    level: float

    @property
    def passed(self) -> bool:
        return bool(self.p.min() > self.level)

    def __str__(self) -> str:
        worst = np.unravel_index(np.argmin(self.p), self.p.shape)
        return (
            f"{self.z.size} block means: z has standard deviation {self.z.std():.3f} and is largest, "
            f"{self.z[worst]:+.2f}, at block {tuple(int(i) for i in worst)}; p = {self.p[worst]:.2e}, "
            f"level {self.level:.2e}; {np.sum(self.p <= self.level)} blocks fail"
        )


def z_test(
    renders: np.ndarray, references: np.ndarray, block: int = 8, level: float = 0.01, scale: float = 0.0
) -> ZTest:
    """Tests whether two sets of independent renders have the same mean.

    ``renders``, ``references``  (batches, H, W, C), at least 8 batches each, rendered with different seeds
    ``block``                    edge, in pixels, of the blocks whose means are compared. Means of blocks are nearly
                                 normally distributed; single pixels of path-traced images are not
    ``level``                    probability that the test fails for equal means
    ``scale``                    largest value of the images that a layer is computed from, if the layer has smaller
                                 values

    It is Welch's t-test for each block and channel, with Šidák's correction 1 - (1 - level)^(1/n). Standard errors are
    at least the rounding of float32 at this scale, so blocks without variance must agree up to rounding. Raises
    ValueError for fewer than 8 batches.
    """
    means, errors = [], []
    for batches in (renders, references):
        if len(batches) < 8:
            raise ValueError(f"{len(batches)} batches: a standard error needs at least 8")
        blocks = _block_means(np.asarray(batches, np.float64), block)
        means.append(blocks.mean(axis=0))
        errors.append(blocks.var(axis=0, ddof=1) / len(blocks))
    scale = max(scale, np.abs(np.stack(means)).max(), float(np.finfo(np.float32).tiny))
    total = errors[0] + errors[1] + (1e-6 * scale) ** 2
    z = (means[0] - means[1]) / np.sqrt(total)
    # Welch-Satterthwaite: the effective degrees of freedom of a sum of two unequal variances.
    freedom = total**2 / (
        errors[0] ** 2 / (len(renders) - 1) + errors[1] ** 2 / (len(references) - 1) + np.finfo(float).tiny
    )
    p = 2 * student_t.sf(np.abs(z), freedom)
    return ZTest(z, p, level=1 - (1 - level) ** (1 / z.size))


def _block_means(batches: np.ndarray, block: int) -> np.ndarray:
    """The means of blocks, (batches, H // block, W // block, C); pixels beyond the last whole block are left out."""
    n, height, width, channels = batches.shape
    rows, columns = height // block, width // block
    cut = batches[:, : rows * block, : columns * block]
    return cut.reshape(n, rows, block, columns, block, channels).mean(axis=(2, 4))
