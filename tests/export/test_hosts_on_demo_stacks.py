"""Every host gives the pixels of ``ngpt denoise`` on the stacks of ``ngpt demo``, unpacked by ``ngpt unpack``.

``pytest -m slow -s`` prints the worst difference of each, relative to the value (of dark ones to a hundredth of the
median); docs/embed/hosts.md publishes them. What is not installed is left out, and named.
"""

import re
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
)

import ngpt
from ngpt.cli import main

pytest.importorskip("onnxruntime")

WEIGHTS = Path(ngpt.__file__).parent / "weights"
SCENES = ("diffuse", "glossy", "environment", "lens")


def ten_lines():
    """The host in Python that CONTRACT.md shows, as it stands there."""
    text = (HOSTS.parent / "CONTRACT.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
    names: dict = {}
    exec(code, names)
    return names["denoise"]


def in_python(path, layers):
    return ten_lines()(str(path), {name: layer[0] for name, layer in layers.items()})[None]


def test_ten_lines_of_python_are_a_host():
    layers = read_layers(VECTOR)
    image = layers.pop("image")
    agree(in_python(WEIGHTS / "ngpt-fast.onnx", layers), image)
    # Without any light kept apart.
    for name in ("direct", "caustic", "caustic_var"):
        del layers[name]
    assert in_python(WEIGHTS / "ngpt-fast.onnx", layers).shape == image.shape


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    """A function: the caller of a host of that kind, which is compiled once."""
    made: dict = {}

    def of(kind):
        if kind not in made:
            made[kind] = caller(kind(tmp_path_factory.mktemp(kind.__name__)))
        return made[kind]

    return of


@pytest.fixture(scope="module", params=SCENES)
def demo(request, renderer, tmp_path_factory):
    """The file of a demo's stack, and the folder it is unpacked into."""
    folder = tmp_path_factory.mktemp(request.param)
    stack = folder / "stack.exr"
    assert main(["render", request.param, "--spp", "16", "--size", "240x160", "-o", str(stack), "--quiet"]) == 0
    assert main(["unpack", str(stack), str(folder / "raw"), "--quiet"]) == 0
    return stack, folder / "raw"


def denoised(stack, method) -> np.ndarray:
    """By the command, (1, 3, H, W)."""
    output = stack.with_name(f"{method}.exr")
    if not output.exists():
        assert main(["denoise", str(stack), "-m", method, "-o", str(output), "--quiet"]) == 0
    return ngpt.read_image(output).transpose(2, 0, 1)[None]


def tell(capsys, request, image, expected, check=agree):
    check(image, expected)
    worst = (np.abs(image - expected) / (np.abs(expected) + 1e-2 * np.median(np.abs(expected)))).max()
    with capsys.disabled():
        print(f"\n{request.node.name}: {worst:.1e}")


@pytest.mark.slow
def test_python(demo, capsys, request):
    stack, raw = demo
    image = in_python(WEIGHTS / "ngpt-fast.onnx", read_layers(raw))
    tell(capsys, request, image, denoised(stack, "ngpt-fast"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [cpp_host, node_host])
# The last is MiB in C++, pixels in Node. 115 MiB hold the image with ngpt-fast, which cannot cut it any smaller.
@pytest.mark.parametrize(("method", "tile"), [("ngpt-fast", 0), ("ngpt-fast", 120)])
def test_cpp_and_node(demo, host, kind, method, tile, capsys, request, tmp_path):
    stack, raw = demo
    result = host(kind)(WEIGHTS / f"{method}.onnx", raw, tmp_path / "image.pfm", tile)
    assert result.returncode == 0, result.stderr
    tell(capsys, request, read_pfm(tmp_path / "image.pfm"), denoised(stack, method))


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0, 70])
@pytest.mark.parametrize("method", ["ngpt-combine", "ngpt-primal"])
def test_cpp_with_oidn(demo, host, method, memory, capsys, request, tmp_path):
    stack, raw = demo
    result = host(oidn_host)(WEIGHTS / f"{method}.onnx", raw, tmp_path / "image.pfm", memory)
    assert result.returncode == 0, result.stderr
    check = agree if method == "ngpt-primal" else agree_but_for_rounding_in_oidn
    tell(capsys, request, read_pfm(tmp_path / "image.pfm"), denoised(stack, method), check)
