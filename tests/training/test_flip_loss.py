"""FLIP on tensors is FLIP, and can be learnt from."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from ngpt.measure.distances import flip
from ngpt.network.transfer import srgb


def picture(seed, blur, size=(48, 64)):
    rng = np.random.default_rng(seed)
    image = np.clip(1.2 * gaussian_filter(rng.random((*size, 3)), (blur, blur, 0)) - 0.1, 0, 1)
    return torch.from_numpy(image.astype(np.float32).transpose(2, 0, 1)[None].copy())


@pytest.mark.parametrize("blur", [0, 1, 4])
def test_maps_are_those_of_the_reference_implementation(blur):
    flip_evaluator = pytest.importorskip("flip_evaluator")
    reference = picture(0, blur)
    image = (reference + 0.1 * torch.randn(reference.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    ours = flip.ldr_flip(image, reference)[0, 0].numpy()
    encoded = [np.ascontiguousarray(srgb(i)[0].permute(1, 2, 0).numpy()) for i in (reference, image)]
    theirs, mean, _ = flip_evaluator.evaluate(*encoded, "LDR", applyMagma=False)
    assert mean > 0.05 and np.abs(ours - np.asarray(theirs).reshape(ours.shape)).max() < 1e-3


def test_the_largest_over_exposures_counts():
    reference = 8 * picture(0, 2)
    image = reference * 1.2
    alone = [flip.flip(image, reference, (e,)) for e in (0.01, 0.25)]
    both = flip.flip(image, reference, (0.01, 0.25))
    assert max(alone) <= both <= sum(alone) and flip.flip(reference, reference, (0.25,)) < 1e-3


@pytest.mark.parametrize("value", [0.0, 1e-20, 1.0, 1e12])
def test_gradients_are_finite_where_images_agree_and_at_extremes(value):
    image = torch.full((1, 3, 24, 24), value, requires_grad=True)
    flip.flip(image, image.detach().clone(), (0.25, 0.01)).backward()
    assert torch.isfinite(image.grad).all()
