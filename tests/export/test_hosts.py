"""The hosts in other languages: each is built and run, and must give the pixels of ``ngpt denoise``.

C++ wants a compiler and ONNX Runtime's headers, of the system or in ORT_ROOT; Node wants onnxruntime-node in a
node_modules that NODE_PATH names, or beside the host; the host with OIDN wants mitsuba-oidn, which has its library. See
docs/embed/hosts.md, which publishes the differences that ``pytest -m slow -s -k pixels`` prints.
"""

import hashlib
import json
import re
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hosts import (
    HOSTS,
    VECTOR,
    agree,
    agree_but_for_rounding_in_oidn,
    caller,
    cpp_host,
    node_host,
    oidn_host,
    read_layers,
    read_pfm,
    repeated,
    stack_of,
)

import ngpt
from ngpt.cli import main
from ngpt.io.rawlayers import write_layers
from ngpt.methods import reconstruct

pytest.importorskip("onnxruntime")

WEIGHTS = Path(ngpt.__file__).parent / "weights"
FAST, PRIMAL = WEIGHTS / "ngpt-fast.onnx", WEIGHTS / "ngpt-primal.onnx"
SCENES = ("diffuse", "glossy", "environment", "lens")


def written(folder, layers) -> Path:
    write_layers(folder, layers)
    return folder


def denoised(stack, method="ngpt-fast") -> np.ndarray:
    return reconstruct(stack, method).image.transpose(2, 0, 1)[None]


@pytest.fixture(scope="module")
def of_python():
    """The host in Python that CONTRACT.md shows, as it stands there."""
    (code,) = re.findall(r"```python\n(.*?)```", (HOSTS.parent / "CONTRACT.md").read_text(), re.S)
    names: dict = {}
    exec(code, names)
    return lambda path, layers: names["denoise"](str(path), {name: layer[0] for name, layer in layers.items()})[None]


@pytest.fixture(scope="module")
def host(toolchain, tmp_path_factory):
    """A function: the caller of a host of that kind, which is compiled once."""
    return cache(lambda kind: caller(kind(tmp_path_factory.mktemp(kind.__name__))))


@pytest.fixture(scope="module", params=["wide", *(pytest.param(name, marks=pytest.mark.slow) for name in SCENES)])
def shot(request, tmp_path_factory):
    """A folder of layers, their stack, and where a host cuts tiles: MiB in C++, in Node pixels.

    Either all that goes wrong, so wide that tiles do not see all of it, or a stack of ``ngpt demo``.
    """
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "wide":
        layers = repeated(23, 440)
        return written(folder / "raw", layers), stack_of(layers), {cpp_host: 27, node_host: 90, oidn_host: 40}
    request.getfixturevalue("renderer")
    stack = folder / "stack.exr"
    words = ["render", request.param, "--sampler", "gpt", "--spp", "16", "--size", "240x160"]
    assert main([*words, "-o", str(stack), "--quiet"]) == 0
    assert main(["unpack", str(stack), str(folder / "raw"), "--quiet"]) == 0
    return folder / "raw", ngpt.read(stack), {cpp_host: 120, node_host: 120, oidn_host: 90}


def tell(capsys, request, image, expected, check=agree):
    check(image, expected)
    worst = (np.abs(image - expected) / (np.abs(expected) + 1e-2 * np.median(np.abs(expected)))).max()
    with capsys.disabled():
        if request.config.getoption("capture") == "no":
            print(f"\n{request.node.name}: {worst:.1e}")


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (cpp_host, "ngpt-fast"),
        (node_host, "ngpt-fast"),
        (oidn_host, "ngpt-combine"),
        (oidn_host, "ngpt-primal"),
    ],
)
def test_a_host_gives_the_pixels_of_denoise(host, shot, kind, method, tiled, capsys, request, tmp_path):
    folder, stack, tiles = shot
    # 90 pixels are no multiple of the alignment: the host must make one of it.
    result = host(kind)(WEIGHTS / f"{method}.onnx", folder, tmp_path / "image.pfm", tiles[kind] if tiled else 0)
    assert result.returncode == 0, result.stderr
    check = agree_but_for_rounding_in_oidn if method == "ngpt-combine" else agree
    tell(capsys, request, read_pfm(tmp_path / "image.pfm"), denoised(stack, method), check)


def test_ten_lines_of_python_give_the_pixels_of_denoise(of_python, shot, capsys, request):
    folder, stack, _ = shot
    tell(capsys, request, of_python(FAST, read_layers(folder)), denoised(stack))


def test_the_vector_is_what_denoise_makes_of_all_that_goes_wrong():
    pytest.importorskip("onnx")
    from ngpt.export.vector import example_layers

    layers, example = read_layers(VECTOR), example_layers()
    for name, entry in json.loads((VECTOR / "layers.json").read_text()).items():
        assert hashlib.sha256((VECTOR / f"{name}.f32").read_bytes()).hexdigest() == entry["sha256"]
        assert name == "image" or np.allclose(layers[name], example[name], equal_nan=True)
    image = layers.pop("image")
    result = reconstruct(stack_of(layers), "ngpt-fast")
    agree(image, result.image.transpose(2, 0, 1)[None])
    assert np.nanmax(layers["direct"]) > 50 and np.nanmax(layers["caustic"]) > 5
    assert result.repaired == 5 + 49 and result.untrusted > 100


@pytest.mark.parametrize("kind", [cpp_host, node_host])
def test_a_host_needs_no_light_kept_apart_and_tells_the_time_of_each_run(host, kind, of_python, tmp_path):
    apart = ("image", "direct", "caustic", "caustic_var")
    layers = {name: layer for name, layer in read_layers(VECTOR).items() if name not in apart}
    result = host(kind)(FAST, written(tmp_path / "layers", layers), tmp_path / "image.pfm", 0, 2)
    assert re.fullmatch(r"(\d+\.\d ms\n){2}", result.stdout) and not result.stderr, result
    expected = denoised(stack_of(layers))
    agree(read_pfm(tmp_path / "image.pfm"), expected)
    agree(of_python(FAST, layers), expected)


@pytest.mark.parametrize("kind", [cpp_host, node_host])
def test_a_host_says_what_is_wrong(host, kind, tmp_path):
    layers, output, alone = read_layers(VECTOR), tmp_path / "image.pfm", tmp_path / "alone.onnx"
    shutil.copy(FAST, alone)
    few = written(tmp_path / "a", {name: layer for name, layer in layers.items() if name != "albedo"})
    wide = written(tmp_path / "wide", repeated(23, 440))
    other = written(tmp_path / "b", layers | {"normal": layers["normal"][..., 1:]})
    for status, message, *arguments in (
        (2, "usage", FAST),
        (2, "usage", FAST, VECTOR, output, "-5"),
        (2, "usage", FAST, VECTOR, output, 0, "many"),
        (1, "none.onnx", tmp_path / "none.onnx", VECTOR, output),
        (1, "statistics|ngpt.inputs", FAST.with_suffix(".statistics.onnx"), VECTOR, output),
        (1, "alone.statistics.onnx", alone, wide, output, 27),
        # This one loads in no time.
        (1, "albedo", PRIMAL, few, output),
        (1, "normal", PRIMAL, other, output),
    ):
        refused(host(kind), status, message, *arguments)
        assert not output.exists()


def refused(call, status, message, *arguments):
    result = call(*arguments)
    assert result.returncode == status and re.search(message, result.stderr), result
    assert result.stderr.count("\n") == 1, result


def test_a_host_with_oidn_says_what_is_wrong(host, tmp_path):
    refused(host(oidn_host), 2, "usage", WEIGHTS / "ngpt-combine.onnx")
    refused(host(oidn_host), 1, "reads no images of OIDN", FAST, VECTOR, tmp_path / "image.pfm")
