"""Networks of OIDN's shape: what PyTorch makes of their weights, OIDN makes of the exported file."""

import struct

import numpy as np
import pytest
import torch
from full_stack import full_stack, hidden_oidn
from hosts import agree

import ngpt
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.network import oidnet, tza
from ngpt.network.features import channels as channels_of
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.safetensors import save_weights
from ngpt.training.cost import per_pixel

SMALL, DEFAULT = oidnet.SHAPES
INPUTS = ("base", "albedo", "normal")


def config(channels=SMALL, base="wcv"):
    return ModelConfig("oidn", channels, (), INPUTS if base else ("primal", "albedo", "normal"), base)


def in_halves(made):
    """A network that changes colours, with weights that 16 bits hold."""
    torch.manual_seed(3)
    model = Reconstructor(made).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_((parameter + 0.004 * torch.randn_like(parameter)).half())
    return model


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The same weights as .safetensors and, by the command, as .tza; of the base, and of the primal."""
    folder = tmp_path_factory.mktemp("networks")
    for name, made in {"small": config(), "primal": config(DEFAULT, base="")}.items():
        save_weights(folder / f"{name}.safetensors", in_halves(made), {})
        arguments = ["export", "--weights", folder / f"{name}.safetensors", "-o", folder / f"{name}.tza"]
        assert main([str(word) for word in arguments]) == 0
    return folder


@pytest.mark.parametrize(("channels", "thousands"), [(SMALL, 62.136), (DEFAULT, 125.406)])
def test_untrained_it_gives_the_colour_back(channels, thousands):
    model = Reconstructor(config(channels))
    assert per_pixel(model.network, channels_of(model.config.inputs))[0] == pytest.approx(1000 * thousands)
    base = 40 * torch.rand(2, 3, 37, 50) ** 4 - 0.01
    with torch.no_grad():
        image = model({"base": base, "albedo": torch.rand(2, 3, 37, 50), "normal": torch.randn(2, 3, 37, 50)})
    assert torch.allclose(image, base.clamp(min=0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["small", "primal"])
def test_oidn_gives_the_pixels_of_pytorch(files, name):
    pytest.importorskip("mitsuba_oidn")
    stack = full_stack(75, 101)
    by_torch, by_oidn = (
        ngpt.reconstruct(stack, "ngpt", weights=str(files / f"{name}{ending}")) for ending in (".safetensors", ".tza")
    )
    agree(by_oidn.image, by_torch.image)
    assert by_oidn.method == f"own network {name}.tza"
    base = ngpt.denoise(stack, "primal" if name == "primal" else "wcv")
    assert np.abs(by_oidn.image - base).mean() > 1e-3 * base.mean()


def test_exposure_changes_nothing(files):
    pytest.importorskip("mitsuba_oidn")
    agree(*(ngpt.denoise(full_stack(40, 40, k), weights=str(files / "small.tza")) / k for k in (2**10, 1)))


def test_wrong_files_end_in_one_line(files, tmp_path):
    stack, good = full_stack(20, 20), (files / "small.tza").read_bytes()
    foreign = tza.packed({"enc_conv0.bias": np.zeros(3)}, "primal").replace(b"ngpt.colour", b"some.colour")
    wrong = {
        "no .tza file": b"something else, and more of it",
        "no .tza file, or a damaged one": good[:5],
        "beyond the end": good[:-8] + struct.pack("<Q", 2**40),
        "does not say which image": foreign,
        "OIDN cannot run on device": tza.packed({"enc_conv0.weight": np.zeros((32, 9, 3, 3))}, "wcv"),
    }
    for message, data in wrong.items():
        (tmp_path / "wrong.tza").write_bytes(data)
        with pytest.raises(NgptError, match=message):
            ngpt.denoise(stack, "ngpt", weights=str(tmp_path / "wrong.tza"))
    path = str(files / "small.tza")
    with pytest.raises(NgptError, match="device 'toaster' is unknown"):
        ngpt.denoise(stack, "ngpt", weights=path, device="toaster")
    with pytest.raises(NgptError, match="which the stack lacks"):
        ngpt.denoise(ngpt.GradientStack.from_arrays(primal=stack["primal"]), "ngpt", weights=path)
    with hidden_oidn(), pytest.raises(NgptError, match="OIDN is not installed"):
        ngpt.denoise(stack, "ngpt", weights=path)
