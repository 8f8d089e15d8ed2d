"""Metrics against their formulas on numbers small enough to do by hand."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.measure.metrics import (
    METRICS,
    compare,
    exposure_mismatch,
    relative_squared_error,
    relmse_trimmed,
    scores,
)


def test_by_hand():
    reference = np.array([[[1.0, 0.0, 2.0], [0.5, 0.5, 0.5]]])
    image = np.array([[[2.0, 0.1, 2.0], [0.5, 0.5, 0.5]]])
    metrics = compare(image, reference)
    assert metrics["relMSE"] == pytest.approx((1 / 1.001 + 0.01 / 0.001) / 6)
    grey = [np.mean([1, 0, 2]), 0.5]
    assert metrics["relMSE NGPT"] == pytest.approx((1 + 0.01) / 3 / (grey[0] ** 2 + 0.001) / 2)
    assert metrics["SMAPE"] == pytest.approx((2 / 3 + 2) / 6)
    assert metrics["MSE"] == pytest.approx((1 + 0.01) / 6)
    assert metrics["max |x - r|"] == pytest.approx(1)
    tone_mapped = ((2 / 3 - 1 / 2) ** 2 + (0.1 / 1.1) ** 2) / 6
    assert metrics["PSNR"] == pytest.approx(-10 * np.log10(tone_mapped))
    assert metrics["nonfinite"] == 0


def test_trimming_removes_the_worst_tenth_of_a_percent(rng):
    reference = np.ones((50, 40, 3))
    image = reference + 0.1
    image[3, 4] = image[7, 8] = 1000  # 2 of 2000 pixels
    metrics = compare(image, reference)
    assert metrics["relMSE"] > 900
    assert metrics["relMSE trimmed"] == pytest.approx(0.01 / 1.001)


def test_nonfinite_pixels_are_left_out_and_counted(rng):
    reference = rng.random((6, 5, 3))
    image = reference + 0.01
    expected = compare(image[1:], reference[1:])
    image[0], reference[0, 2] = np.nan, np.inf
    metrics = compare(image, reference)
    assert metrics.pop("nonfinite") == 5 and expected.pop("nonfinite") == 0
    assert metrics == pytest.approx(expected)


def test_errors(rng):
    with pytest.raises(NgptError, match="5x4 and 4x4"):
        compare(np.zeros((4, 5, 3)), np.zeros((4, 4, 3)))
    with pytest.raises(NgptError, match="none of 16 pixels"):
        compare(np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)))


def test_exposure_mismatch_is_in_stops_and_survives_fireflies(rng):
    reference = rng.random((60, 50, 3)) + 0.1
    image = 4 * reference
    assert exposure_mismatch(image, reference) == pytest.approx(2)
    image[3, 4], image[5, 6] = 1e6, np.nan
    assert exposure_mismatch(image, reference) == pytest.approx(2, abs=0.02)
    assert exposure_mismatch(0 * reference, reference) == 0


SQUARED = [name for name, metric in METRICS.items() if metric.squared]


def draws_of(name: str, count: int, noise: float) -> tuple[float, np.ndarray, np.ndarray]:
    """The true error of an image, and estimates of it over ``count`` noisy references: by halves, by their mean."""
    rng = np.random.default_rng(5)
    truth = rng.uniform(0.5, 2, (30, 40, 3))
    image = truth * (1 + 0.02 * rng.standard_normal(truth.shape))
    estimates = []
    for _ in range(count):
        a, b = truth + noise * truth * rng.standard_normal((2, *truth.shape))
        estimates.append([scores([name], image, *halves)[name] for halves in ((a, b), ((a + b) / 2,))])
    return scores([name], image, truth)[name], *np.array(estimates).T


@pytest.mark.parametrize("name", SQUARED)
def test_halves_take_the_noise_of_the_reference_off(name):
    """The mean over references is the true error; one reference of the same samples adds its variance."""
    true, halves, one = draws_of(name, 400, 0.03)
    # The mean of two halves has a relative variance of noise² / 2, here as large as the error of the image.
    both = 1 + 0.03**2 / 2 / 0.02**2
    if name == "PSNR":  # the tone curve makes a small bias of it
        assert halves.mean() == pytest.approx(true, abs=0.05)
        assert one.mean() == pytest.approx(true - 10 * np.log10(both), abs=0.1)
        return
    standard_error = halves.std() / np.sqrt(len(halves))
    # Trimming sees the reference's noise.
    assert abs(halves.mean() - true) < 4 * standard_error + 0.01 * (one.mean() - true)
    assert standard_error < 0.01 * true and one.mean() == pytest.approx(true * both, rel=0.03)


def test_the_pixels_trimmed_are_those_far_from_the_mean_of_the_halves(rng):
    """Whatever the sign of their products."""
    truth = np.ones((50, 40, 3))
    a, b = truth + 0.1 * rng.standard_normal((2, 50, 40, 3))
    image = truth.copy()
    image[3, 4] = 1000
    image[7, 8], a[7, 8] = 2, 10  # a product of about -8
    clean = np.ones((50, 40), bool)  # without these 2 of 2000 pixels
    clean[3, 4] = clean[7, 8] = False
    expected = relative_squared_error(image, a, b).mean(axis=-1)[clean].mean()
    assert relmse_trimmed(image, a, b) == pytest.approx(expected)


def test_pixels_that_are_not_finite_in_one_half_are_left_out(rng):
    x, a, b = rng.random((3, 6, 5, 3)) + 0.1
    names = [name for name, metric in METRICS.items() if not metric.whole]
    expected = scores(names, x[1:], a[1:], b[1:])
    a[0, :3], b[0, 3:] = np.nan, np.inf
    assert scores(names, x, a, b) == pytest.approx(expected)
    with pytest.raises(NgptError, match="none of 30 pixels is finite in all images"):
        scores(names, x, a, b * np.nan)


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_says_what_is_better(name, rng):
    metric = METRICS[name]
    if metric.missing and metric.missing():
        pytest.skip(metric.missing())
    y, x = np.mgrid[0:24, 0:32] / 8
    reference = np.stack([1 + np.sin(x + c) * np.cos(y) / 2 for c in range(3)], axis=-1)
    noise = rng.normal(0, 0.05, reference.shape)
    equal, less, more = (scores([name], reference + k * noise, reference)[name] for k in (0, 1, 4))
    assert (equal < less < more) if metric.better == "lower" else (equal > less > more)
