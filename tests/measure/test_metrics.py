"""Metrics against their formulas on numbers small enough to do by hand."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.measure.metrics import compare, exposure_mismatch


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


def test_equal_images(rng):
    image = rng.random((4, 4, 3)).astype(np.float32)
    metrics = compare(image, image)
    assert metrics["relMSE"] == 0 and metrics["PSNR"] == float("inf")


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
