"""The networks: their size, what they see, and the reconstruction around them."""

import numpy as np
import pytest
import torch

from ngpt.network import features, padding
from ngpt.network.model import WINDOW, ModelConfig, Reconstructor, parameters
from ngpt.network.transfer import signed_log
from ngpt.network.unet import POOLING, Convolution, DenseUNet, PlainUNet, Resampling
from ngpt.training.cost import per_pixel

NGPT = ("primal", "dx", "dy", "albedo", "normal", "depth")
PAPER = {"network": "dense", "channels": (40, 80, 80, 80), "units": (4, 3, 2, 2)}


def tiny(network="dense", inputs=NGPT, base=""):
    torch.manual_seed(0)
    config = ModelConfig(network, (4, 6, 8), (1, 2, 1), inputs + (("base",) if base else ()), base)
    model = Reconstructor(config)
    if base:
        torch.nn.init.normal_(model.network.head.convolution.weight, std=0.1)
    return model.eval()


def layers(height, width, inputs=NGPT, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {name: torch.rand(1, features.CHANNELS[name], height, width, generator=generator) for name in inputs}


def test_the_papers_network_has_the_papers_parameters():
    # Read from the released checkpoints.
    model = Reconstructor(ModelConfig(**PAPER, inputs=NGPT))
    net = model.network
    assert parameters(model) == 4_358_534
    assert [parameters(block) for block in net.down] == [140_480, 462_240, 295_360, 295_360]
    assert [parameters(block) for block in net.up] == [217_280, 654_240, 397_760, 346_560]
    assert [parameters(pool) for pool in net.pool] == [112_960, 256_320, 205_120]
    assert [parameters(unpool) for unpool in net.unpool] == [256_160, 409_920, 307_520]
    assert parameters(net.head) == 1_254
    assert len([m for m in model.modules() if isinstance(m, Convolution)]) == 51
    assert round(per_pixel(model)[0] / 1000) == 830


@pytest.mark.parametrize("kind", ["1x1", "3x3", "pool", "unpool"])
def test_weights_have_norm_root_two_whatever_their_scale(kind):
    convolution = Convolution(5, 7, kind)
    torch.nn.init.normal_(convolution.v, std=123)
    output = 1 if kind == "unpool" else 0
    norms = convolution.weight().transpose(0, output).flatten(1).norm(dim=1)
    assert torch.allclose(norms, torch.full((7,), 2**0.5), rtol=1e-5)


# The largest of 2x2 has a slope at one of them only, so that what it sees is not seen in one go.
@pytest.mark.parametrize("pooling", [pooling for pooling in POOLING if pooling != "maximum"])
@pytest.mark.parametrize("network", ["dense", "plain"])
def test_the_receptive_field_is_as_stated_and_no_smaller_than_needed(network, pooling):
    torch.manual_seed(1)
    net = (
        DenseUNet(3, (4, 4, 4), (1, 2, 1), pooling=pooling)
        if network == "dense"
        else PlainUNet(3, (4, 4, 4), pooling=pooling)
    )
    size = 8 * net.alignment * 4
    x = torch.rand(1, 3, size, size, requires_grad=True)
    reach = 0
    # The reach depends on where in its coarsest pixel the output lies.
    for offset in range(net.alignment):
        center = size // 2 + offset
        (gradient,) = torch.autograd.grad(net(x)[0, :, center, center].sum(), x)
        seen = torch.nonzero(gradient[0].abs().sum(0))
        reach = max(reach, int((seen - center).abs().max()))
    assert reach == net.radius


def test_ways_to_halve_and_double():
    x = torch.rand(1, 2, 4, 6, generator=torch.Generator().manual_seed(3))
    small = {name: Resampling(2, 3, name, up=False) for name in POOLING[1:]}
    large = {name: Resampling(2, 3, name, up=True) for name in POOLING[1:]}
    for changes in (*small.values(), *large.values()):
        changes.load_state_dict(small["average"].state_dict())
    flat = small["average"].convolution(x)
    blocks = flat.reshape(1, 3, 2, 2, 3, 2).movedim(4, 3).flatten(4)
    assert torch.allclose(small["average"](x), blocks.mean(4))
    assert torch.allclose(small["bilinear"](x), blocks.mean(4))
    assert torch.equal(small["maximum"](x), blocks.amax(4))
    for name in ("average", "maximum"):
        assert torch.equal(large[name](x), flat.repeat_interleave(2, 2).repeat_interleave(2, 3))
    # Between the centres of coarse pixels a ramp stays a ramp.
    between = large["bilinear"](x)[..., 1:-1, 1:-1]
    a, b, c, d = flat[..., :-1, :-1], flat[..., :-1, 1:], flat[..., 1:, :-1], flat[..., 1:, 1:]
    assert torch.allclose(between[..., ::2, ::2], (9 * a + 3 * b + 3 * c + d) / 16, atol=1e-6)
    assert torch.allclose(between[..., 1::2, 1::2], (a + 3 * b + 3 * c + 9 * d) / 16, atol=1e-6)


def test_a_firefly_stays_local():
    model = tiny()
    data = layers(64, 256)
    # So that an untrained network's bounds are out of the way.
    data["primal"][..., 0, 0] = 1e6
    lit = {name: layer.clone() for name, layer in data.items()}
    lit["primal"][..., 30, 40] = 1e6
    with torch.no_grad():
        before, after = model(data), model(lit)
    far = slice(40 + model.network.radius + 16, None)
    # Where an untrained network's image crosses zero, one percent of a pixel is nothing.
    assert ((after - before).abs() <= 0.01 * (before.abs() + 0.1))[..., far].all()
    assert torch.isfinite(after).all()


def combiner():
    """Everything computed of other layers, and a choice of three images to start from; untrained, but not zero."""
    start = ("base", "denoised", "denoised_base")
    return ModelConfig("dense", (4, 6), (1, 1), ("primal", "denoised", *features.SOURCES), "wcv", start)


def test_an_untrained_combiner_is_the_mean_of_what_it_starts_from():
    config = combiner()
    data = layers(20, 20, config.layers)
    mean = sum(data[name] for name in config.start) / 3
    with torch.no_grad():
        assert torch.allclose(Reconstructor(config)(data), mean.clamp(max=data["primal"].amax()), rtol=1e-4, atol=1e-5)


def test_weights_of_a_combiner_choose():
    model = Reconstructor(combiner())
    head = model.network.head.convolution
    data = layers(20, 20, model.config.layers)
    data["primal"][0, :, 0, 0] = 2
    for i, name in enumerate(model.config.start):
        torch.nn.init.zeros_(head.bias)
        head.bias.data[3 + i] = 50
        with torch.no_grad():
            assert torch.allclose(model(data), data[name], rtol=1e-4, atol=1e-5)


def converging(quiet=0.1):
    inputs = ("primal", "base", "primal_se")
    return ModelConfig("dense", (4, 6), (1, 1), inputs, "wcv", ("primal", "base"), quiet)


def anything(config):
    """A network of that configuration that has no idea."""
    torch.manual_seed(0)
    model = Reconstructor(config).eval()
    torch.nn.init.normal_(model.network.head.convolution.weight, std=0.5)
    return model


def both(data, config=None):
    """What such a network makes of it as it is, and of the same where it never goes over to its base."""
    model = anything(config or converging())
    with torch.no_grad():
        result = model(data)
        model.config = converging(0)
        return result, model(data)


def test_noise_says_how_much_a_converging_network_counts():
    data = layers(40, 32, converging().layers)
    data["base"].fill_(0.5)
    model, base = anything(converging()), signed_log(data["base"])
    for error, share in ((0.0125, 0.245), (0.0255, 0.5), (0.06, 1), (7, 1)):
        data["primal_se"].fill_(error)
        with torch.no_grad():
            model.config = converging()
            result = model.predict(data)
            model.config = converging(0)
            free = model.predict(data)
        assert torch.allclose(result - base, share * (free - base), rtol=0.01, atol=1e-5)


def test_a_converging_network_returns_a_converged_base():
    data = layers(20, 20, converging().layers)
    data["primal_se"].fill_(1e-7)
    result, free = both(data)
    assert torch.allclose(result, data["base"].clamp(max=data["primal"].amax()), rtol=1e-4, atol=1e-5)
    assert (free - result).abs().max() > 0.1


def test_unknown_noise_leaves_the_network_alone():
    data = layers(20, 60, converging().layers)
    data["primal_se"][..., :30] = 0
    data["primal_se"][..., 30:] = 1e-7
    result, free = both(data)
    # Up to the rounding of going away from the base and back.
    unknown = np.s_[..., : 30 - WINDOW // 2]
    assert torch.allclose(result[unknown], free[unknown], rtol=1e-5, atol=1e-6)
    base = data["base"].clamp(max=data["primal"].amax())
    assert torch.allclose(result[..., 30 - WINDOW // 2 :], base[..., 30 - WINDOW // 2 :], rtol=1e-4, atol=1e-5)


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


def test_computed_inputs_are_relative_to_the_base_where_the_network_reads_it():
    inputs = ("primal", "base", "primal_change", "dy_base", "primal_noise")
    data = layers(9, 14, ("primal", "base", "dy", "primal_se"))
    assert features.sources(inputs) == ("primal", "base", "dy", "primal_se")
    completed = features.completed(data, inputs)
    base = data["base"]
    assert torch.equal(completed["primal_change"], signed_log(data["primal"]) - signed_log(base))
    slope = data["dy"] - base.diff(dim=-2, append=base[..., -1:, :])
    assert torch.equal(completed["dy_base"], slope / (1 + base.abs()))
    noise = data["primal_se"].mean(1, keepdim=True) / (1 + base.abs().mean(1, keepdim=True))
    assert torch.equal(completed["primal_noise"], noise)


def test_exposure_is_the_typical_radiance():
    image = torch.full((2, 3, 64, 64), 0.5)
    image[1] = 0
    scale = features.exposure(image)
    assert scale.flatten().tolist() == pytest.approx([0.5 / features.KEY, 1])
    image[0, :, :16] = 1e9
    assert features.exposure(image)[0].item() == pytest.approx(0.5 / features.KEY)
    # Black surroundings do not count.
    image[0, :, 20:] = 0
    image[0, :, :20] = 0.25
    assert features.exposure(image)[0].item() == pytest.approx(0.25 / features.KEY, rel=0.8)


def test_channels_are_where_the_paper_has_them():
    data = layers(8, 8)
    data["primal"] -= 0.5
    data["dx"] -= 0.5
    x = features.encode(data, NGPT)
    assert x.shape[1] == features.channels(NGPT) == 16
    assert torch.equal(x[:, :3], torch.log1p(data["primal"].clamp(min=0)))
    assert torch.equal(x[:, 3:6], data["dx"].sign() * torch.log1p(data["dx"].abs()))
    assert torch.equal(x[:, 9:12], data["albedo"]) and torch.equal(x[:, 15:], data["depth"])


def test_what_a_stack_must_hold():
    assert ModelConfig("plain", (4,), (), ("primal", "albedo")).needs == ("primal", "albedo")
    config = ModelConfig("plain", (4,), (), ("primal", "base", "dx_se"), "wcv")
    assert config.needs == ("primal", "dx", "dy", "primal_var", "dx_var", "dy_var")
    # The other denoiser wants features, though the network does not read them.
    twin = ModelConfig("plain", (4,), (), ("primal", "primal_change", "primal_noise"), start=("primal", "denoised"))
    assert twin.layers == ("primal", "denoised", "primal_se")
    assert twin.needs == ("primal", "albedo", "normal", "primal_var") and twin.head.outputs == 5
