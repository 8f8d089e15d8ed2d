"""What all networks must do, of every kind and with every head: any size, exposure and light, tiles, files, slopes."""

import pytest
import torch
from networks import NETWORKS, brighter, layers_for, untrained

from ngpt.network.run_torch import reconstruct
from ngpt.network.safetensors import load_weights, save_weights

every_network = pytest.mark.parametrize("name", NETWORKS)


def made(model, layers):
    with torch.no_grad():
        return model(layers)


@every_network
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (17, 16)])
def test_any_size_and_any_exposure(name, size):
    model = untrained(NETWORKS[name])
    layers = layers_for(model.config, *size)
    image = made(model, layers)
    assert image.shape == (1, 3, *size) and torch.isfinite(image).all()
    for stops in (-10, 10):
        k = 2.0**stops
        assert torch.allclose(made(model, brighter(layers, k)), k * image, rtol=1e-3, atol=1e-4 * k)


@every_network
@pytest.mark.parametrize("value", [0.0, 65504.0, 1e12])
def test_any_light_is_bounded_by_itself(name, value):
    model = untrained(NETWORKS[name])
    layers = brighter(layers_for(model.config, 16, 24), value)
    image = made(model, layers)
    assert torch.isfinite(image).all() and image.min() >= 0
    if model.config.network != "kpcn":
        assert image.max() <= 1.01 * max(layers[n].max() for n in ("primal", *model.config.start)) + 1e-6


@every_network
def test_tiles_do_not_show(name):
    model = untrained(NETWORKS[name])
    tile = 2 * model.radius + 8 * model.alignment
    layers = layers_for(model.config, 24, 2 * tile)
    whole = made(model, layers)
    assert torch.allclose(reconstruct(model, layers, tile=tile), whole, rtol=1e-4, atol=1e-5)


@every_network
def test_a_file_gives_the_network_back_and_every_weight_has_a_slope(name, tmp_path):
    """Each output of the last convolution has a slope: what heads make of a prediction reaches training."""
    # Closer to a beginning: far from it, codes of OIDN's shape are beyond what floats hold.
    model = untrained(NETWORKS[name], 0.02)
    layers = layers_for(model.config, 32, 32)
    save_weights(tmp_path / "w.safetensors", model, {})
    again, _ = load_weights(tmp_path / "w.safetensors")
    assert again.config == model.config and torch.equal(made(again, layers), made(model, layers))
    model.train()(layers).square().mean().backward()
    slopes = [parameter.grad for parameter in model.parameters()]
    assert all(torch.isfinite(slope).all() for slope in slopes)
    # Of OIDN's activations some have no slope at random weights.
    assert model.config.network == "oidn" or all(slope.abs().max() > 0 for slope in slopes)
    if model.config.sweeps:
        rows = model.network.head.convolution.weight.grad[model.config.head.inner.outputs :]
        assert rows.flatten(1).abs().amax(1).min() > 0
