"""Networks in ONNX Runtime: tiles, memory, devices, and what is wrong with files."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from full_stack import full_layers, full_stack

from ngpt.errors import NgptError
from ngpt.methods import METHODS, reconstruct
from ngpt.network.run_onnx import Cancelled, Network
from ngpt.network.shipped import WEIGHTS
from ngpt.stack import GradientStack

FAST = WEIGHTS / "ngpt-fast.onnx"


@pytest.fixture(scope="module")
def network():
    return Network(FAST)


@pytest.fixture(scope="module")
def image():
    """Layers, with the base, of an image that takes many tiles, and the whole of it."""
    layers = full_layers(333, 497)
    layers["base"] = layers["primal"] * 0.9
    return layers, Network(FAST).reconstruct(layers)


def least(network, size=(333, 497)):
    """MiB of the smallest tile of an image of that size."""
    with pytest.raises(NgptError) as caught:
        network.plan(*size, 3)
    return int(str(caught.value).split("takes ")[1].split()[0])


# The smallest tiles are mostly overlap, and take long.
SMALLEST = [pytest.param(1, 1, marks=pytest.mark.slow), pytest.param(1.3, 2, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("tiles", "batch"), [(1.7, 1), (1.3, 1), (1.3, 3), *SMALLEST])
def test_tiles_do_not_show(network, image, tiles, batch):
    """In memory for so many of the smallest tiles."""
    layers, whole = image
    memory = int(tiles * batch * least(network))
    tiles, size = network.plan(333, 497, memory, batch)
    assert len(tiles) > 1 and size[0] * size[1] * network.bytes * batch <= memory * 2**20
    tiled = network.reconstruct(layers, memory=memory, batch=batch)
    assert np.abs(tiled - whole).max() <= 1e-5 * whole.max()


@pytest.mark.parametrize("size", [(1, 1), (7, 900), (1080, 1920), (333, 1001), (4320, 8192)])
@pytest.mark.parametrize("memory", [220, 300, 2048])
def test_plans_cover_every_pixel_once_with_all_it_needs(network, size, memory):
    tiles, (rows, columns) = network.plan(*size, memory)
    count = np.zeros(size, np.uint8)
    for y, x, top, left in tiles:
        count[y, x] += 1
        for inner, begin, extent, length in ((y, top, rows, size[0]), (x, left, columns, size[1])):
            assert begin % network.alignment == 0 and begin >= 0 and begin + extent <= length
            assert begin == 0 or inner.start - begin >= network.overlap
            assert begin + extent == length or begin + extent - inner.stop >= network.overlap
    assert (count == 1).all()


def test_progress_and_stop(network, image):
    layers, _ = image
    calls, memory = [], int(1.7 * least(network))
    network.reconstruct(layers, memory=memory, progress=lambda *call: calls.append(call))
    total = calls[0][1]
    assert total > 3 and calls == [(i, total) for i in range(total + 1)]
    seen = []
    with pytest.raises(Cancelled, match=f"2 of {total}"):
        network.reconstruct(layers, memory=memory, progress=lambda *call: seen.append(call), stop=lambda: len(seen) > 2)


def test_memory_that_does_not_hold_a_tile_is_refused_with_what_would(network, image):
    with pytest.raises(NgptError, match=r"smallest tile takes (\d+) MiB, and 3 MiB are allowed") as caught:
        network.plan(333, 497, 3)
    assert str(least(network)) in str(caught.value) and network.plan(333, 497, least(network))[0]


@pytest.mark.parametrize("bound", [pytest.param(220, marks=pytest.mark.slow), 400])
def test_memory_stays_within_the_bound(bound):
    """In a process of its own, by the largest size it ever had."""
    code = f"""
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, "tests")
from full_stack import full_layers
from ngpt.network.run_onnx import Network
layers = full_layers(700, 900)
layers["base"] = layers["primal"]
network = Network({str(FAST)!r})
network.reconstruct({{name: layer[:8, :8] for name, layer in layers.items()}})
def megabytes(field):
    return int(dict(line.split(":") for line in open("/proc/self/status"))[field].split()[0]) / 1024
before = megabytes("VmRSS")
open("/proc/self/clear_refs", "w").write("5")  # forgets the peak so far
network.reconstruct(layers, memory={bound})
print(megabytes("VmHWM") - before)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    result_image = 700 * 900 * 3 * 4 / 2**20
    assert float(result.stdout) <= bound + result_image


@pytest.mark.slow
def test_8192x4320_pixels_in_4_gib():
    """Beside the stack itself, which takes 3.4 GiB: repair, base, tiles and the result."""
    code = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, "tests")
import numpy as np
from full_stack import full_layers
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
small = full_layers(540, 1024)
layers = {name: np.tile(layer, (8, 8, 1)) for name, layer in small.items()}
layers["dx"][:, -1] = layers["dy"][-1] = 0
stack = GradientStack(layers)
del layers
def mebibytes(field):
    return int(dict(line.split(":") for line in open("/proc/self/status"))[field].split()[0]) / 1024
before = mebibytes("VmRSS")
open("/proc/self/clear_refs", "w").write("5")
image = reconstruct(stack, "ngpt-fast").image
assert image.shape == (4320, 8192, 3) and np.isfinite(image).all()
print(mebibytes("VmHWM") - before)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) <= 4096, result.stdout


@pytest.mark.parametrize(
    ("device", "message"),
    [("tensorrt", "device 'tensorrt': this build of ONNX Runtime has only: cpu"), ("abacus", "device 'abacus' is unk")],
)
def test_devices_that_are_not_there_are_named_not_replaced(device, message):
    with pytest.raises(NgptError, match=message):
        Network(FAST, device)


def test_bad_files(tmp_path):
    with pytest.raises(NgptError, match="no such file"):
        Network(tmp_path / "none.onnx")
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(FAST.read_bytes()[:5000])
    with pytest.raises(NgptError, match=r"damaged\.onnx: ONNX Runtime cannot load it"):
        Network(damaged)
    with pytest.raises(NgptError, match=r"statistics\.onnx: lacks the metadata"):
        Network(WEIGHTS / "ngpt-fast.statistics.onnx")


def test_the_method_takes_files_of_both_kinds():
    pytest.importorskip("torch")
    stack = full_stack(20, 30)
    twin = Path(__file__).parents[2] / "export" / "weights" / "ngpt-fast.safetensors"
    images = [reconstruct(stack, "ngpt-fast", weights=str(path)).image for path in (FAST, twin)]
    assert np.allclose(*images, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("oidn", [True, False])
def test_auto_takes_the_best_network_there_is(monkeypatch, oidn):
    if oidn and METHODS["oidn"].missing():
        pytest.skip(METHODS["oidn"].missing())
    if not oidn:
        for name in ("ngpt-combine", "ngpt-primal", "oidn"):
            monkeypatch.setitem(METHODS, name, replace(METHODS[name], missing=lambda: "OIDN is not installed"))
    stack = full_stack(20, 30)
    first = "ngpt-combine" if oidn else "ngpt-fast"
    assert reconstruct(stack).method == first
    assert reconstruct(stack, memory=300).method == first
    bare = {name: layer for name, layer in stack.layers.items() if not name.startswith(("dx", "dy"))}
    assert reconstruct(GradientStack(bare)).method == ("oidn" if oidn else "nfor")
    assert reconstruct(GradientStack({"primal": stack["primal"]})).method == ("oidn" if oidn else "nfor")
