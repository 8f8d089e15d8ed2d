"""The z-test itself: it must keep its level on equal means and find small differences."""

import numpy as np
import pytest
from scipy.stats import ttest_ind

from ngpt.testing import z_test


def renders(rng, batches=16):
    """Noise with heavy tails, as of path-traced pixels."""
    return rng.lognormal(sigma=1.5, size=(batches, 32, 32, 3))


def test_equal_means_fail_no_more_often_than_the_level(rng):
    failures = sum(not z_test(renders(rng), renders(rng, 24), level=0.05).passed for _ in range(200))
    # Binomial with n = 200, p = 0.05: mean 10, standard deviation 3.1.
    assert failures <= 20


def test_finds_a_small_difference(rng):
    a, b = renders(rng), renders(rng)
    error = np.sqrt((a.var(axis=0).mean() + b.var(axis=0).mean()) / 16 / 64)
    b[:, 8:16, 8:16, 1] += 12 * error  # in one block and channel only
    result = z_test(a, b)
    assert not result.passed and np.unravel_index(np.argmin(result.p), result.p.shape) == (1, 1, 1)


def test_blocks_without_variance_must_agree():
    flat = np.ones((8, 16, 16, 3))
    assert z_test(flat, flat * (1 + 1e-7)).passed and not z_test(flat, flat * 1.001).passed
    rounded = flat * np.linspace(1e-8, 2e-8, 8)[:, None, None, None]
    assert not z_test(rounded, 0 * flat).passed and z_test(rounded, 0 * flat, scale=1.0).passed


def test_is_the_test_of_welch(rng):
    a, b = rng.normal(size=(8, 8, 8, 1)), rng.normal(0.5, 2, size=(12, 8, 8, 1))
    welch = ttest_ind(a.mean(axis=(1, 2, 3)), b.mean(axis=(1, 2, 3)), equal_var=False)
    assert z_test(a, b).z.item() == pytest.approx(welch.statistic, rel=1e-6)
    assert z_test(a, b).p.item() == pytest.approx(welch.pvalue, rel=1e-6)


def test_needs_enough_batches(rng):
    with pytest.raises(ValueError, match="4 batches"):
        z_test(renders(rng, 4), renders(rng))
