"""The networks: their size, what they see, and the reconstruction around them."""

import numpy as np
import pytest
import torch
from networks import ALL, dense, layers_for, untrained
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from ngpt.network import features, padding
from ngpt.network.features import channels as channels_of
from ngpt.network.model import WINDOW, ModelConfig, Reconstructor, parameters
from ngpt.network.transfer import signed_log
from ngpt.network.unet import POOLING, Convolution, DenseUNet, PlainUNet, Resampling
from ngpt.training.cost import per_pixel


def layers(height, width, names):
    return {name: torch.rand(1, features.CHANNELS[name], height, width) for name in names}


def test_the_papers_network_has_the_papers_parameters():
    # Read from the released checkpoints.
    model = Reconstructor(ModelConfig("dense", (40, 80, 80, 80), (4, 3, 2, 2), ALL))
    assert parameters(model) == 4_358_534
    assert len([m for m in model.modules() if isinstance(m, Convolution)]) == 51
    assert round(per_pixel(model.network, channels_of(model.config.inputs))[0] / 1000) == 830


# The largest of 2x2 has a slope at one of them only, so that what it sees is not seen in one go.
@pytest.mark.parametrize("pooling", [pooling for pooling in POOLING if pooling != "maximum"])
@pytest.mark.parametrize("network", ["dense", "plain"])
def test_the_receptive_field_is_as_stated_and_no_smaller_than_needed(network, pooling):
    torch.manual_seed(1)
    sizes = ((4, 4, 4), (1, 2, 1)) if network == "dense" else ((4, 4, 4),)
    net = {"dense": DenseUNet, "plain": PlainUNet}[network](3, *sizes, pooling=pooling)
    size = 8 * net.alignment * 4
    x = torch.rand(1, 3, size, size, requires_grad=True)
    reach = 0
    # The reach depends on where in its coarsest pixel the output lies.
    for center in range(size // 2, size // 2 + net.alignment):
        (gradient,) = torch.autograd.grad(net(x)[0, :, center, center].sum(), x)
        seen = torch.nonzero(gradient[0].abs().sum(0))
        reach = max(reach, int((seen - center).abs().max()))
    assert reach == net.radius


def test_ways_to_halve_and_double():
    x = torch.rand(1, 2, 4, 6, generator=torch.Generator().manual_seed(3))
    small, large = ({name: Resampling(2, 3, name, up=up) for name in POOLING[1:]} for up in (False, True))
    for changes in (*small.values(), *large.values()):
        changes.load_state_dict(small["average"].state_dict())
    flat = small["average"].convolution(x)
    for name, blocks in (("average", avg_pool2d), ("bilinear", avg_pool2d), ("maximum", max_pool2d)):
        assert torch.allclose(small[name](x), blocks(flat, 2))
    for name, mode in (("average", "nearest"), ("maximum", "nearest"), ("bilinear", "bilinear")):
        assert torch.allclose(large[name](x), interpolate(flat, scale_factor=2, mode=mode), atol=1e-6)


def test_a_combiner_begins_with_the_mean_and_its_weights_choose():
    start = ("base", "denoised", "denoised_base")
    model = Reconstructor(dense(("primal", "denoised", *features.SOURCES), "wcv", start=start))
    data = layers_for(model.config, 20, 20)
    data["primal"][0, :, 0, 0] = 2
    bias, wanted = model.network.head.convolution.bias, {None: sum(data[name] for name in start) / 3}
    wanted |= {3 + i: data[name] for i, name in enumerate(start)}
    for channel, image in wanted.items():
        torch.nn.init.zeros_(bias)
        if channel is not None:
            bias.data[channel] = 50
        with torch.no_grad():
            assert torch.allclose(model(data), image, rtol=1e-4, atol=1e-5)


def converging(height, width):
    """A network that goes over to its base where noise is below 0.1, and never; layers for it; no idea of either."""
    made = [
        untrained(dense(("primal", "base", "primal_se"), "wcv", start=("primal", "base"), quiet=quiet), 0.5)
        for quiet in (0.1, 0)
    ]
    return (*made, layers_for(made[0].config, height, width))


@pytest.mark.parametrize(("error", "share"), [(0.0125, 0.245), (0.0255, 0.5), (0.06, 1), (7, 1)])
def test_noise_says_how_much_a_converging_network_counts(error, share):
    model, free, data = converging(40, 32)
    data["base"].fill_(0.5)
    data["primal_se"].fill_(error)
    base = signed_log(data["base"])
    with torch.no_grad():
        moved, whole = model.predict(data) - base, free.predict(data) - base
    assert torch.allclose(moved, share * whole, rtol=0.01, atol=1e-5)


def test_a_converging_network_returns_a_converged_base_and_unknown_noise_leaves_it_alone():
    model, free, data = converging(20, 60)
    data["primal_se"][..., :30], data["primal_se"][..., 30:] = 0, 1e-7
    with torch.no_grad():
        result, alone = model(data), free(data)
    unknown, known = np.s_[..., : 30 - WINDOW // 2], np.s_[..., 30 - WINDOW // 2 :]
    # Up to the rounding of going away from the base and back.
    assert torch.allclose(result[unknown], alone[unknown], rtol=1e-5, atol=1e-6)
    base = data["base"].clamp(max=data["primal"].amax())
    assert torch.allclose(result[known], base[known], rtol=1e-4, atol=1e-5)
    assert (alone - result)[known].abs().max() > 0.1


def test_what_is_computed_agrees_with_padding():
    """The contradiction of an image and its own differences is none, nor is it across the mirrors of the padding."""
    data = layers(9, 14, ("denoised", "primal_se"))
    image = data["denoised"]
    data |= {"dx": image.diff(dim=-1, append=image[..., -1:]), "dy": image.diff(dim=-2, append=image[..., -1:, :])}
    data["denoised_base"] = image + 1e-3
    inputs = ("dx_denoised", "dy_denoised", "denoised_base_change", "dy_denoised_base")
    completed = features.completed(data, inputs)
    padded = padding.pad({**completed, "dx": data["dx"]}, padding.pads(9, 14, 4))
    assert padded["dx_denoised"].abs().max() == padded["dy_denoised"].abs().max() == 0
    assert padded["dy_denoised_base"].abs().max() < 1e-6
    assert (completed["denoised_base_change"] - 1e-3 / (1 + image)).abs().max() < 1e-6
    # One that is wrong by 0.1 in one place.
    data["dx"][0, 0, 4, 5] += 0.1
    wrong = features.completed(data, inputs)["dx_denoised"]
    assert wrong[0, 0, 4, 5].item() == pytest.approx(0.1 / (1 + image[0, 0, 4, 5].item()))
    assert (wrong != 0).sum() == 1


def test_exposure_is_the_typical_radiance():
    image = torch.full((2, 3, 64, 64), 0.5)
    image[1] = 0
    assert features.exposure(image).flatten().tolist() == pytest.approx([0.5 / features.KEY, 1])
    image[0, :, :16] = 1e9
    assert features.exposure(image)[0].item() == pytest.approx(0.5 / features.KEY)
    # Black surroundings do not count.
    image[0, :, 20:], image[0, :, :20] = 0, 0.25
    assert features.exposure(image)[0].item() == pytest.approx(0.25 / features.KEY, rel=0.8)


def test_what_a_stack_must_hold():
    assert dense(("primal", "albedo")).needs == ("primal", "albedo")
    of_base = ("primal", "dx", "dy", "primal_var", "dx_var", "dy_var")
    assert dense(("primal", "base", "dx_se"), "wcv").needs == of_base
    # The other denoiser wants features, though the network does not read them.
    twin = dense(("primal", "primal_change", "primal_noise"), start=("primal", "denoised"))
    assert twin.layers == ("primal", "denoised", "primal_se")
    assert twin.needs == ("primal", "albedo", "normal", "primal_var") and twin.head.outputs == 5
