"""Heads: what they make of a prediction, and that one by kernels learns."""

import pytest
import torch
from torch.nn.functional import avg_pool2d

from ngpt.network.heads import Direct, Kernels, Mixture, Pyramid, Residual
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.transfer import signed_exp, signed_log
from ngpt.network.weights import load_weights, save_weights

HEADS = [Direct(), Residual(("base",)), Mixture(("primal", "base")), Kernels(("primal", "base"), 3)]


def images(head, height=9, width=11):
    """Those that a head reads, of radiance from 0 to 1 but one pixel of 1e12."""
    r = head.radius
    generator = torch.Generator().manual_seed(0)
    made = [torch.rand(1, 3, height + 2 * r, width + 2 * r, generator=generator) for _ in head.start]
    for image in made:
        image[0, 0, 4, 5] = 1e12
    return made


def of_kernels(prediction, given, head):
    return signed_exp(head.forward(prediction, given))


@pytest.mark.parametrize("head", HEADS[1:], ids=lambda head: type(head).__name__)
def test_a_prediction_of_nothing_is_the_mean_of_what_the_head_reads(head):
    given = images(head)
    mean = sum(avg_pool2d(image, 2 * head.radius + 1, 1) for image in given) / len(given)
    assert torch.allclose(of_kernels(torch.zeros(1, head.outputs, 9, 11), given, head), mean, rtol=1e-5)


@pytest.mark.parametrize("size", [1, 3, 5])
def test_a_kernel_picks_the_pixel_it_points_to(size):
    head = Kernels(("primal", "base"), size)
    given = images(head)
    for tap in range(head.outputs):
        i, (y, x) = tap // size**2, divmod(tap % size**2, size)
        prediction = torch.zeros(1, head.outputs, 9, 11)
        prediction[:, tap] = 200
        assert torch.allclose(of_kernels(prediction, given, head), given[i][..., y : y + 9, x : x + 11], rtol=1e-5)


def test_kernels_stay_between_the_least_and_the_largest_pixel():
    head = HEADS[3]
    given = [image.clamp(max=3) for image in images(head)]
    result = of_kernels(20 * torch.randn(1, head.outputs, 9, 11), given, head)
    assert result.min() >= min(image.min() for image in given) - 1e-6
    assert result.max() <= max(image.max() for image in given) + 1e-5


def pyramid(demodulate=False, size=3, scales=3):
    return Pyramid(("primal",), size, scales, demodulate)


def everywhere(head, trust=0.0, share=0.0, size=(16, 24)):
    """A prediction of flat kernels with the same trust and shares in every pixel."""
    prediction = torch.zeros(1, head.outputs, *size)
    taps = head.size**2
    for scale in range(head.scales - 1):
        prediction[:, 1 + scale * (taps + 1) + taps] = share
    prediction[:, 0] = trust
    return prediction


@pytest.mark.parametrize("trust", [-50.0, 0.0, 50.0])
def test_a_pyramid_leaves_a_plain_image_as_it_is(trust):
    """To the border, beyond which there is nothing to average."""
    image = torch.full((1, 3, 16, 24), 7.0)
    head = pyramid()
    assert torch.allclose(of_kernels(everywhere(head, trust), [image], head), image, rtol=1e-5)


@pytest.mark.parametrize(("scales", "least", "most"), [(2, 0.6, 0.8), (4, 0.3, 0.65)])
def test_coarse_pixels_replace_what_fine_ones_average_to(scales, least, most):
    """Shares of 0 leave the mean over the finest kernel; with 1 its low frequencies come from the coarsest."""
    torch.manual_seed(0)
    head = pyramid(scales=scales)
    image = torch.rand(1, 3, 32, 32)
    fine = of_kernels(everywhere(head, share=-50, size=(32, 32)), [image], head)
    # Trust is over 1 + brightness.
    weight = 1 / (1 + image.mean(1, keepdim=True))
    inside = avg_pool2d(image * weight, 3, 1) / avg_pool2d(weight, 3, 1)
    assert torch.allclose(fine[..., 1:-1, 1:-1], inside, rtol=1e-4)
    coarse = of_kernels(everywhere(head, share=50, size=(32, 32)), [image], head)
    assert least < coarse.std() / fine.std() < most


def test_a_pixel_that_is_not_trusted_lights_no_other():
    head = pyramid(size=5)
    image = torch.ones(1, 3, 16, 24)
    image[..., 8, 9] = 1e6
    prediction = everywhere(head, trust=50, share=0)
    prediction[:, 0, 8, 9] = -50
    assert (of_kernels(prediction, [image], head) - 1).abs().max() < 2e-3
    prediction[:, 0, 8, 9] = 50
    assert of_kernels(prediction, [image], head).max() > 1.01


def test_texture_of_the_albedo_is_not_averaged():
    torch.manual_seed(0)
    head = pyramid(demodulate=True)
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 16, 24)
    image = 3 * albedo
    assert head.reads == ("primal", "reflectance")
    kept = of_kernels(everywhere(head), [image, albedo], head)
    plain = pyramid()
    lost = of_kernels(everywhere(plain), [image], plain)
    assert torch.allclose(kept, image, rtol=1e-4) and (lost - image).abs().mean() > 0.3


def of_a_pyramid(demodulate=True, **changes):
    config = {"inputs": ("primal", "albedo"), "start": ("primal",), "kernel": 3, "scales": 3, **changes}
    return ModelConfig("plain", (6, 6, 6), (), demodulate=demodulate, **config)


def test_a_pyramid_learns(tmp_path):
    """Noise on a wall whose paint changes in each pixel: far below what averages without the albedo reach."""
    torch.manual_seed(0)
    model = Reconstructor(of_a_pyramid())
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 32, 32)
    clean = albedo * 4
    layers = {"primal": clean * (1 + 0.6 * torch.randn(clean.shape)).clamp(min=0.1), "albedo": albedo}

    def loss():
        return (signed_log(model(layers)) - signed_log(clean)).square().mean()

    noise = (signed_log(layers["primal"]) - signed_log(clean)).square().mean().item()
    optimizer = torch.optim.Adam(model.parameters(), 1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    assert loss().item() < 0.1 * noise
    save_weights(tmp_path / "w.safetensors", model, {})
    again, _ = load_weights(tmp_path / "w.safetensors")
    with torch.no_grad():
        assert again.config == model.config and torch.equal(again(layers), model(layers))
