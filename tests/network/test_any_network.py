"""What all networks must do, of every kind and with every head: any size, any exposure, any light, and tiles."""

import pytest
import torch
from networks import NETWORKS, brighter, layers_for, untrained

from ngpt.network.run_torch import reconstruct

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
