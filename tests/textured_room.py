"""A path-traced image with a texture that only the albedo tells, and what any denoiser must make of it."""

import numpy as np
import pytest

from ngpt.methods import reconstruct
from ngpt.stack import GradientStack


def textured_room(rng):
    """A stack, 40x30, of two walls with that texture; and the image without noise."""
    y, x = np.mgrid[0:30, 0:40]
    light = 1 + 0.5 * np.cos(x / 9)[..., None] * np.array([1.0, 0.9, 0.8])
    albedo = 0.2 + 0.6 * ((x // 3 + y // 3) % 2)[..., None] * np.ones(3)
    normal = np.where((x < 20)[..., None], [1.0, 0, 0], [0, 0, 1.0])
    clean = albedo * light
    deviation = 0.3 * clean
    stack = GradientStack.from_arrays(
        primal=clean + rng.normal(0, 1, clean.shape) * deviation,
        primal_var=deviation**2,
        albedo=albedo,
        normal=normal,
        depth=np.ones((30, 40, 1)),
    )
    return stack, clean


def error(image, clean):
    return float(np.mean((image - clean) ** 2 / clean**2))


def keeps_texture(method, stack, clean):
    """The noise falls, and the texture, its contrast and the brightness stay."""
    image = reconstruct(stack, method).image
    assert image.dtype == np.float32 and image.shape == clean.shape
    assert error(image, clean) < 0.35 * error(stack["primal"], clean)
    dark, bright = clean[..., 0] < 0.45, clean[..., 0] > 0.7
    contrast, expected = (i[bright].mean() / i[dark].mean() for i in (image, clean))
    assert contrast == pytest.approx(expected, rel=0.1)
    assert image.mean() == pytest.approx(clean.mean(), rel=0.03)
