"""Heads: what they make of a prediction, and that networks learn by them."""

import pytest
import torch
from networks import close, image_of, no_graph
from torch.nn.functional import avg_pool2d

from ngpt.network.heads import Mixture, Pyramid, Residual
from ngpt.network.model import ModelConfig

BOTH = ("primal", "base")


def images(head, height=9, width=11):
    """Images that a head reads, of radiance from 0 to 1 but one pixel of 1e12."""
    made = [torch.rand(1, 3, height + 2 * head.radius, width + 2 * head.radius) for _ in head.start]
    for image in made:
        image[0, 0, 4, 5] = 1e12
    return made


@pytest.mark.parametrize("head", [Residual(("base",)), Mixture(BOTH)], ids=lambda head: type(head).__name__)
def test_a_prediction_of_nothing_is_the_mean_of_what_the_head_reads(head):
    given = images(head)
    mean = sum(avg_pool2d(image, 2 * head.radius + 1, 1) for image in given) / len(given)
    assert close(image_of(torch.zeros(1, head.outputs, 9, 11), given, head), mean)


def pyramid(image, trust=0.0, share=0.0, reflectance=None, **changes):
    """The result of flat kernels with the same trust (or one for each pixel) and shares everywhere."""
    head = Pyramid(("primal",), **{"size": 3, "scales": 3, "demodulate": reflectance is not None} | changes)
    prediction = torch.zeros(1, head.outputs, *image.shape[-2:])
    for scale in range(head.scales - 1):
        prediction[:, (scale + 1) * (head.size**2 + 1)] = share
    prediction[:, 0] = trust
    return image_of(prediction, [image] if reflectance is None else [image, reflectance], head)


@pytest.mark.parametrize("trust", [-50.0, 0.0, 50.0])
def test_a_pyramid_leaves_a_plain_image_as_it_is(trust):
    """To the border, beyond which there is nothing to average."""
    image = torch.full((1, 3, 16, 24), 7.0)
    assert close(pyramid(image, trust), image)


@pytest.mark.parametrize(("scales", "least", "most"), [(2, 0.6, 0.8), (4, 0.3, 0.65)])
def test_coarse_pixels_replace_what_fine_ones_average_to(scales, least, most):
    """Shares of 0 leave the mean over the finest kernel; with 1 its low frequencies come from the coarsest."""
    torch.manual_seed(0)
    image = torch.rand(1, 3, 32, 32)
    fine, coarse = (pyramid(image, share=share, scales=scales) for share in (-50, 50))
    # Trust is over 1 + brightness.
    weight = 1 / (1 + image.mean(1, keepdim=True))
    assert close(fine[..., 1:-1, 1:-1], avg_pool2d(image * weight, 3, 1) / avg_pool2d(weight, 3, 1))
    assert least < coarse.std() / fine.std() < most


def test_a_pixel_that_is_not_trusted_lights_no_other():
    image, trust = torch.ones(1, 3, 16, 24), torch.full((16, 24), 50.0)
    image[..., 8, 9] = 1e6
    assert pyramid(image, trust, size=5).max() > 1.01
    trust[8, 9] = -50
    assert (pyramid(image, trust, size=5) - 1).abs().max() < 2e-3


def test_texture_of_the_albedo_is_not_averaged():
    torch.manual_seed(0)
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 16, 24)
    assert Pyramid(("primal",), 3, 3, True).reads == ("primal", "reflectance")
    assert close(pyramid(3 * albedo, reflectance=albedo), 3 * albedo)
    assert (pyramid(3 * albedo) - 3 * albedo).abs().mean() > 0.3


def test_light_of_two_parts_has_no_graph(tmp_path):
    assert no_graph(tmp_path, ModelConfig("dense", (4,), (1,), ("primal", "diffuse_se")))
