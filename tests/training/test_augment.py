"""Augmentation and padding keep the laws of the gradient domain."""

import numpy as np
import pytest
import torch

from ngpt.network import padding
from ngpt.stack import GradientStack
from ngpt.training import augment
from ngpt.training.augment import Augmentation, quieter


def differences(image):
    dx, dy = torch.zeros_like(image), torch.zeros_like(image)
    dx[..., :-1] = image[..., 1:] - image[..., :-1]
    dy[..., :-1, :] = image[..., 1:, :] - image[..., :-1, :]
    return dx, dy


def example(height=9, width=13, seed=0):
    """Layers whose differences are exact, over a height field whose normals follow from it."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(3, height, width, generator=generator)
    dx, dy = differences(image)
    depth = torch.rand(1, height, width, generator=generator)
    return {
        "primal": image, "dx": dx, "dy": dy, "target": image.clone(), "base": image.clone(),
        "albedo": torch.rand(3, height, width, generator=generator), "depth": depth, "normal": slopes(depth),
        "primal_se": image.clone(), "dx_se": dx.abs(), "dy_se": dy.abs(),
    }  # fmt: skip


def slopes(height):
    """Normals of a height field toward the viewer, x right and y up, by central differences with wrap-around."""
    x = (height.roll(-1, -1) - height.roll(1, -1)) / 2
    y = (height.roll(1, -2) - height.roll(-1, -2)) / 2
    n = torch.cat([-x, -y, torch.ones_like(height)])
    return n / n.norm(dim=0)


def repainted(layers):
    return augment.scale(augment.color(layers, np.array([2, 0, 1]), np.array([0.5, 1.0, 1.5])), 3)


def anything(seed):
    return lambda layers: Augmentation()(layers, np.random.default_rng(seed))


TRANSFORMS = {t.__name__: t for t in (augment.flip_x, augment.flip_y, augment.transpose, repainted)}
TRANSFORMS |= {f"anything {seed}": anything(seed) for seed in range(4)}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms_keep_the_laws_of_layers(name):
    before = example()
    after = TRANSFORMS[name](before)
    for layer, difference in zip(("dx", "dy"), differences(after["primal"]), strict=True):
        torch.testing.assert_close(after[layer], difference, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(after[f"{layer}_se"], difference.abs(), rtol=1e-4, atol=1e-5)
    assert torch.equal(after["target"], after["primal"]) and not torch.equal(after["primal"], before["primal"])
    if name == "repainted":
        assert torch.allclose(after["primal"][0], 1.5 * before["primal"][2])
        assert torch.allclose(after["albedo"][2], 1.5 * before["albedo"][1])
        assert torch.equal(after["normal"], before["normal"])
    elif not name.startswith("anything"):
        assert torch.allclose(after["normal"], slopes(after["depth"]), atol=1e-6)
        twice = TRANSFORMS[name](after)
        assert all(torch.allclose(twice[layer], before[layer]) for layer in before)


def test_factors_have_mean_one():
    rng = np.random.default_rng(2)
    layers = {"primal": torch.ones(3, 1, 1), "target": torch.ones(3, 1, 1)}
    draws = torch.stack([Augmentation()(layers, rng)["primal"].flatten() for _ in range(4000)])
    # Per-channel variance: E[c²] E[b²] - 1 = 1.5 e - 1 = 3.08 for c = 3 Dirichlet(1, 1, 1), b log-normal of sigma 1.
    assert (draws.mean(0) - 1).abs().max() < 4 * (3.08 / 4000) ** 0.5


def test_a_quieter_stack_has_a_part_of_the_noise():
    """Errors and standard errors of all layers shrink alike, and the stack stays one."""
    rng = np.random.default_rng(3)
    light, direct, caustic = rng.random((6, 9, 3), np.float32), *np.zeros((2, 6, 9, 3), np.float32)
    direct[2, 3], caustic[4, 5] = 7, 3
    whole = light + direct + caustic
    truth = {"primal": whole, "direct": direct, "caustic": caustic}
    truth |= {"dx": np.diff(light, axis=1, append=light[:, -1:]), "dy": np.diff(light, axis=0, append=light[-1:])}
    noisy = {name: layer + rng.standard_normal((6, 9, 3), np.float32) for name, layer in truth.items()}
    variances = {f"{name}_var": rng.random((6, 9, 3), np.float32) for name in ("primal", "dx", "dy", "caustic")}
    albedo = rng.random((6, 9, 3), np.float32)
    stack = GradientStack.from_arrays(**noisy, **variances, albedo=albedo, attributes={"ngpt:spp": 4})
    result = quieter(stack, whole, direct, caustic, 0.1)
    for name, layer in truth.items():
        assert np.allclose(result[name] - layer, 0.1 * (noisy[name] - layer), atol=1e-5)
    for name, layer in variances.items():
        assert np.allclose(result[name], 0.01 * layer)
    assert np.array_equal(result["albedo"], albedo) and np.array_equal(stack["primal"], noisy["primal"])
    bare = GradientStack.from_arrays(primal=noisy["primal"])
    assert quieter(bare, whole, direct, caustic, 0.1).names == ("primal",)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (16, 24)])
def test_padding_reflects_and_keeps_the_differences(size):
    layers = {name: layer[None] for name, layer in example(*size).items()}
    pads = padding.pads(*size, 8)
    padded = padding.pad(layers, pads)
    image = padded["primal"]
    assert image.shape[-2] % 8 == 0 == image.shape[-1] % 8 and min(pads) >= padding.MARGIN
    dx, dy = differences(image)
    assert torch.allclose(padded["dx"][..., :-1], dx[..., :-1], atol=1e-6)
    assert torch.allclose(padded["dy"][..., :-1, :], dy[..., :-1, :], atol=1e-6)
    assert torch.allclose(padded["dx_se"][..., :-1], dx[..., :-1].abs(), atol=1e-6)
    assert torch.equal(padding.crop(image, pads), layers["primal"])
    assert torch.equal(padding.crop(padded["depth"], pads), layers["depth"])
