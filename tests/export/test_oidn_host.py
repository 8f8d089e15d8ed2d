"""The C++ host that calls Open Image Denoise gives the pixels of ``ngpt denoise`` with the networks that correct it.

Needs mitsuba-oidn, which has OIDN's library in it, a C++ compiler and ONNX Runtime's headers (docs/embed/hosts.md).
"""

from pathlib import Path

import numpy as np
import pytest
from hosts import agree, agree_but_for_rounding_in_oidn, caller, oidn_host, read_pfm

import ngpt
from ngpt.classical.bases import BASES
from ngpt.denoisers import caustic
from ngpt.export.vector import example_layers, quiet
from ngpt.io.rawlayers import write_layers
from ngpt.methods import reconstruct
from ngpt.network.inputs import DENOISED, Oidn, denoised
from ngpt.repair import repair
from ngpt.stack import GradientStack

WEIGHTS = Path(ngpt.__file__).parent / "weights"


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    return caller(oidn_host(tmp_path_factory.mktemp("oidn")))


def planes_of(image) -> np.ndarray:
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None])


@pytest.fixture(scope="module")
def stack():
    """A folder of layers with all that goes wrong, and their stack; wide, so that there is more than one tile."""
    layers = {name: layer for name, layer in example_layers().items() if not name.startswith("denoised")}
    wide = {name: np.tile(layer, (1, 1, 3, 5)) for name, layer in layers.items()}
    return wide, GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in wide.items()})


@pytest.mark.parametrize("memory", [0, 40])
@pytest.mark.parametrize("method", ["ngpt-combine", "ngpt-primal"])
def test_a_host_with_oidn_gives_the_pixels_of_denoise(host, stack, method, memory, tmp_path):
    layers, held = stack
    write_layers(tmp_path / "layers", layers)
    result = host(WEIGHTS / f"{method}.onnx", tmp_path / "layers", tmp_path / "image.pfm", memory)
    assert result.returncode == 0, result.stderr
    check = agree if method == "ngpt-primal" else agree_but_for_rounding_in_oidn
    check(read_pfm(tmp_path / "image.pfm"), planes_of(reconstruct(held, method).image))


def test_a_host_with_oidn_says_what_is_wrong(host, stack, tmp_path):
    layers, _ = stack
    write_layers(tmp_path / "layers", layers)
    for status, message, *arguments in (
        (2, "usage", WEIGHTS / "ngpt-combine.onnx"),
        (1, "reads no images of OIDN", WEIGHTS / "ngpt-fast.onnx", tmp_path / "layers", tmp_path / "image.pfm"),
    ):
        result = host(*arguments)
        assert result.returncode == status and message in result.stderr and result.stderr.count("\n") == 1, result


@pytest.mark.parametrize("method", ["ngpt-combine", "ngpt-primal"])
def test_of_the_same_images_of_oidn_the_graph_makes_the_pixels_of_denoise(stack, method):
    pytest.importorskip("mitsuba_oidn")
    onnxruntime = pytest.importorskip("onnxruntime")
    layers, held = stack
    data = repair(held, gradients=method == "ngpt-combine")
    base = BASES["wcv"](data) if data.caustic is not None else None
    made = denoised(Oidn(data), base, DENOISED)
    given = layers | {name: planes_of(image + data.direct) for name, image in made.items()}
    session = onnxruntime.InferenceSession(WEIGHTS / f"{method}.onnx", quiet())
    feed = {each.name: given[each.name] for each in session.get_inputs()}
    if data.caustic is not None:
        feed["denoised_caustic"] = np.full_like(layers["caustic"], np.nan)
        feed["denoised_caustic"][:, :, ::2, ::2] = planes_of(caustic.of_half_size(data))
    image = session.run(["image"], feed)[0]
    agree(image, planes_of(reconstruct(held, method).image))
