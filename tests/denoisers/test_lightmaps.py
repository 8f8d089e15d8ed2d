"""Lightmaps: islands of light on nothing, which a mask keeps apart, and OIDN's filter for them."""

import numpy as np
import pytest
from scipy import ndimage

from ngpt.coverage import mirrored
from ngpt.denoisers import oidn
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

needs_oidn = pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())


@pytest.fixture
def islands(rng):
    """Eight of them: their light, what is covered, and a noisy estimate."""
    light, covered = np.zeros((64, 64, 3)), np.zeros((64, 64), bool)
    for top in (4, 34):
        for left in (2, 18, 34, 50):
            place = np.s_[top : top + 26, left : left + 12]
            covered[place], light[place] = True, rng.uniform(0.1, 3, 3)
    light *= (0.5 + np.arange(64) / 64)[:, None, None]
    return light, covered, (light * rng.gamma(1, 1, light.shape)).astype(np.float32)


@needs_oidn
def test_alpha_keeps_the_light_of_islands_apart(islands):
    light, covered, noisy = islands
    border = covered & ~ndimage.binary_erosion(covered, iterations=2)
    alpha = covered[..., None].astype(np.float32)
    stacks = GradientStack.from_arrays(primal=noisy), GradientStack.from_arrays(primal=noisy, alpha=alpha)
    plain, masked = (reconstruct(stack, "oidn").image for stack in stacks)
    errors = [np.mean(((image - light) ** 2 / (light**2 + 1e-9))[border]) for image in (plain, masked)]
    assert errors[1] < 0.7 * errors[0]
    assert not masked[~covered].any()
    assert masked[covered].mean() == pytest.approx(noisy[covered].mean(), rel=0.05)


@needs_oidn
def test_the_filter_for_lightmaps_is_oidns(islands):
    _, covered, noisy = islands
    stack = GradientStack.from_arrays(primal=noisy, albedo=noisy)
    found = reconstruct(stack, "oidn", filter="lightmap")
    assert found.options == {"filter": "lightmap"} and not np.array_equal(found.image, reconstruct(stack, "oidn").image)
    assert found.image[covered].mean() == pytest.approx(noisy[covered].mean(), rel=0.2)
    # Coefficients have signs.
    signed = GradientStack.from_arrays(primal=np.where(covered[..., None], -0.5, 0.25) * np.ones(3) + 0.01 * noisy)
    image = reconstruct(signed, "oidn", filter="directional").image
    assert image[covered].mean() == pytest.approx(signed["primal"][covered].mean(), abs=0.1)


def test_a_mirror_shows_each_island_itself():
    image = np.arange(1.0, 8)[None, :, None]
    empty = np.array([[False, False, False, True, True, True, False]])
    assert mirrored(image, empty)[0, :, 0].tolist() == [1, 2, 3, 2, 1, 7, 7]
    assert mirrored(image, ~empty & empty) is image
