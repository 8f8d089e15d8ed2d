"""``ngpt unpack``: the layers of any renderer's file as raw files with our names."""

import numpy as np
from exr_files import write_raw
from full_stack import full_stack
from hosts import read_layers

import ngpt
from ngpt.io.rawlayers import planes


def test_every_bit_of_every_layer(tmp_path, command):
    stack = full_stack(9, 12)
    stack["primal"][2, 3] = np.nan
    ngpt.write(tmp_path / "s.exr", stack)
    assert "12x9, primal, dx" in command("unpack s.exr raw").err
    layers = read_layers(tmp_path / "raw")
    assert tuple(layers) == stack.names and layers["depth"].shape == (1, 1, 9, 12)
    for name, layer in planes(stack).items():
        assert np.array_equal(layers[name], layer, equal_nan=True)


def test_names_are_ours_whatever_wrote_the_file(tmp_path, rng, command):
    image, normal = rng.random((2, 5, 7, 3)).astype(np.float32)
    channels = {f"ViewLayer.Combined.{c}": image[..., i] for i, c in enumerate("RGB")}
    channels |= {f"odd.{c}": normal[..., i] for i, c in enumerate("XYZ")}
    write_raw(tmp_path / "cycles.exr", (channels,))
    command("unpack cycles.exr raw --layer normal=odd")
    layers = read_layers(tmp_path / "raw")
    for name, layer in (("primal", image), ("normal", normal)):
        assert np.array_equal(layers.pop(name)[0].transpose(1, 2, 0), layer)
    assert not layers
