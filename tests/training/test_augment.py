"""Augmentation and padding keep the laws of the gradient domain."""

import numpy as np
import pytest
import torch

from ngpt.network import padding
from ngpt.stack import GradientStack
from ngpt.training import augment
from ngpt.training.augment import Augmentation, quieter, rarer


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


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_rarer_light_keeps_its_mean_and_says_its_variance(share):
    """Over many draws of the same estimates, errors are what the layers of variances say, in the mean."""
    rng, k = np.random.default_rng(5), 6.0
    direct, caustic = np.zeros((2, 40, 40, 3))
    direct[2, 3], caustic[4, 5] = 7, 3
    truth = {"primal": np.full((40, 40, 3), 2.0) + direct + caustic, "dx": np.full((40, 40, 3), 1.5)}
    truth["dy"] = np.full((40, 40, 3), -0.5)
    scale = {"primal": 0.3, "dx": 0.2, "dy": 0.1}
    drawn, told = {name: [] for name in truth}, {name: [] for name in truth}
    for _ in range(100):
        noisy = {name: layer + scale[name] * rng.standard_normal(layer.shape) for name, layer in truth.items()}
        variances = {f"{name}_var": np.full((40, 40, 3), scale[name] ** 2) for name in truth}
        stack = GradientStack.from_arrays(**noisy, **variances, direct=direct, caustic=caustic)
        result = rarer(stack, k, share, rng)
        assert np.array_equal(result["direct"], stack["direct"]) and np.array_equal(result["caustic"], stack["caustic"])
        for name in truth:
            drawn[name].append(result[name])
            told[name].append(result[f"{name}_var"].mean())
    for name, layer in truth.items():
        errors = np.array(drawn[name]) - layer
        # The mean of 480,000 draws; a column and a row have no neighbour on one side.
        assert abs(errors.mean()) < 4 * errors.std() / errors.size**0.5
        # The noise of X itself counts in the variance that B adds: in the square of what is found.
        assert (errors**2).mean() == pytest.approx(np.mean(told[name]), rel=0.05)
    # A pixel without light found has 1 - share of it.
    found = np.array(drawn["primal"]).mean(-1) - direct.mean(-1) - caustic.mean(-1)
    assert np.mean(found < 2 * (1 - share) + 0.5) == pytest.approx(1 - 1 / k, abs=0.01)
    bare = GradientStack.from_arrays(primal=truth["primal"])
    assert rarer(bare, k, share, rng).names == ("primal",)


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
