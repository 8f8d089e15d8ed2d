"""Perceptual metrics: order, invariances, and that their parameters come from the reference."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.measure import flip, perceptual
from ngpt.measure.metrics import METRICS


@pytest.fixture
def reference(rng):
    y, x = np.mgrid[0:24, 0:32] / 8
    return (np.stack([1 + np.sin(x + c) * np.cos(y) for c in range(3)], axis=-1) ** 3 + 0.05).astype(np.float32)


def test_ssim_orders_noise_and_needs_its_window(reference, rng):
    pytest.importorskip("skimage")
    noise = rng.normal(0, 0.1, reference.shape)
    (equal, _), (near, similarity), (far, _) = (perceptual.ssim(reference + k * noise, reference) for k in (0, 1, 3))
    assert equal == pytest.approx(1) and 1 > near > far
    assert similarity[5:-5, 5:-5].mean() == pytest.approx(near) and similarity.shape == reference.shape[:2]
    with pytest.raises(NgptError, match="9x10; its window takes 11x11"):
        perceptual.ssim(reference[:10, :9], reference[:10, :9])


def test_flip_is_that_of_its_authors(reference, rng):
    flip_evaluator = pytest.importorskip("flip_evaluator")
    image = np.maximum(reference + rng.normal(0, 0.2, reference.shape), 0).astype(np.float32)
    mean, errors = flip.flip(image, reference)
    assert errors.shape == reference.shape[:2] and errors.mean() == pytest.approx(mean, rel=1e-4)
    # Left to itself, FLIP takes its exposures from the reference by the same rule.
    _, expected, parameters = flip_evaluator.evaluate(reference, image, "HDR", applyMagma=False)
    assert mean == pytest.approx(expected, rel=1e-3)
    start, stop, count = flip.flip_exposures(reference)
    found = [parameters[name] for name in ("startExposure", "stopExposure", "numExposures")]
    assert [start, stop, count] == pytest.approx(found, abs=0.01)  # its median of an even number is one of the two


def test_black_reference_and_sizes(reference):
    assert flip.flip_exposures(0 * reference) == (0.0, 0.0, 2)
    with pytest.raises(NgptError, match="different size"):
        flip.flip(reference, reference[:-1])


def test_elpips_without_weights_says_what_is_missing(reference):
    pytest.importorskip("torch")
    assert "E-LPIPS needs its fitted weights" in METRICS["E-LPIPS"].missing()
    with pytest.raises(NgptError, match="E-LPIPS needs its fitted weights"):
        perceptual.elpips(reference, reference)
