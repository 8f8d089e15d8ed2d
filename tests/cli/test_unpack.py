"""``ngpt unpack``: the layers of any renderer's file as raw files with our names."""

import numpy as np
from exr_files import write_raw
from full_stack import full_stack
from hosts import read_layers

import ngpt
from ngpt.cli import main
from ngpt.io.rawlayers import planes


def test_every_bit_of_every_layer(tmp_path, capsys):
    stack = full_stack(9, 12)
    stack["primal"][2, 3] = np.nan
    ngpt.write(tmp_path / "s.exr", stack)
    assert main(["unpack", str(tmp_path / "s.exr"), str(tmp_path / "raw")]) == 0
    layers = read_layers(tmp_path / "raw")
    assert tuple(layers) == stack.names and layers["depth"].shape == (1, 1, 9, 12)
    for name, layer in planes(stack).items():
        assert np.array_equal(layers[name], layer, equal_nan=True)
    assert "12x9, primal, dx" in capsys.readouterr().err


def test_names_are_ours_whatever_wrote_the_file(tmp_path, rng):
    image, albedo, normal = rng.random((3, 5, 7, 3)).astype(np.float32)
    channels = {f"ViewLayer.Combined.{c}": image[..., i] for i, c in enumerate("RGB")}
    channels |= {f"ViewLayer.Denoising Albedo.{c}": albedo[..., i] for i, c in enumerate("RGB")}
    channels |= {f"odd.{c}": normal[..., i] for i, c in enumerate("XYZ")}
    path = write_raw(tmp_path / "cycles.exr", (channels,))
    assert main(["unpack", str(path), str(tmp_path / "raw"), "--layer", "normal=odd"]) == 0
    layers = read_layers(tmp_path / "raw")
    assert set(layers) == {"primal", "albedo", "normal"}
    for name, layer in (("primal", image), ("albedo", albedo), ("normal", normal)):
        assert np.array_equal(layers[name][0].transpose(1, 2, 0), layer)
