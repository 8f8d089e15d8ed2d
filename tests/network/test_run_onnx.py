"""Networks in ONNX Runtime: tiles, memory, devices, and what is wrong with files."""

import sys
from pathlib import Path

import numpy as np
import pytest
from full_stack import full_layers
from processes import complete

from ngpt.errors import NgptError
from ngpt.network.run_onnx import Cancelled, Network
from ngpt.network.shipped import WEIGHTS

FAST, COMBINE = WEIGHTS / "ngpt-fast.onnx", WEIGHTS / "ngpt-combine.onnx"
SIZE = (305, 341)


@pytest.fixture(
    scope="module", params=[FAST, pytest.param(COMBINE, marks=pytest.mark.slow)], ids=lambda path: path.stem
)
def network(request):
    return Network(request.param)


@pytest.fixture(scope="module")
def image(network):
    """Layers, with the base, of an image that takes many tiles, and the whole of it."""
    layers = full_layers(*SIZE)
    layers |= {name: layers["primal"] * 0.9 for name in ("base", *network.inputs) if name not in layers}
    return layers, network.reconstruct(layers)


@pytest.fixture(scope="module")
def least(network):
    """MiB of the smallest tile of that image, as the message says it."""
    with pytest.raises(NgptError, match=r"smallest tile takes (\d+) MiB, and 3 MiB are allowed") as caught:
        network.plan(*SIZE, 3)
    found = int(str(caught.value).split("takes ")[1].split()[0])
    assert network.plan(*SIZE, found)[0]
    return found


# The smallest tiles are mostly overlap, and take long.
@pytest.mark.parametrize(("tiles", "batch"), [(1.3, 1), (1.3, 3), pytest.param(1, 1, marks=pytest.mark.slow)])
def test_tiles_do_not_show_and_tell_how_far_they_are(network, image, least, tiles, batch):
    """In memory for so many of the smallest tiles."""
    layers, whole = image
    memory, calls = int(tiles * batch * least), []
    tiles, size = network.plan(*SIZE, memory, batch)
    assert len(tiles) > 1 and size[0] * size[1] * network.bytes * batch <= memory * 2**20
    tiled = network.reconstruct(layers, memory=memory, batch=batch, progress=lambda *call: calls.append(call))
    assert np.abs(tiled - whole).max() <= 1e-5 * whole.max()
    assert calls[0] == (0, len(tiles)) and calls[-1] == (len(tiles), len(tiles)) and calls == sorted(calls)
    assert batch > 1 or len(calls) == len(tiles) + 1


@pytest.mark.parametrize("size", [(1, 1), (7, 900), (333, 1001), (1080, 1920)])
@pytest.mark.parametrize("memory", [220, 2048])
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


def test_it_stops_when_asked_to(network, image, least):
    seen = []
    with pytest.raises(Cancelled, match="2 of "):
        network.reconstruct(
            image[0], memory=int(1.3 * least), progress=lambda *call: seen.append(call), stop=lambda: len(seen) > 2
        )


MEASURED = """
import sys
sys.path.insert(0, "tests")
from full_stack import full_layers
from ngpt.network.run_onnx import Network
def mebibytes(field):
    return int(dict(line.split(":") for line in open("/proc/self/status"))[field].split()[0]) / 1024
layers, network = full_layers(410, 520), Network(sys.argv[1])
layers |= {name: layers["primal"] for name in ("base", *network.inputs) if name not in layers}
network.reconstruct({name: layer[:8, :8] for name, layer in layers.items()})
before = mebibytes("VmRSS")
open("/proc/self/clear_refs", "w").write("5")  # forgets the peak so far
network.reconstruct(layers, memory=400)
print(mebibytes("VmHWM") - before)
"""


@pytest.mark.parametrize("file", [pytest.param(FAST, marks=pytest.mark.slow), COMBINE], ids=lambda file: file.stem)
def test_memory_stays_within_the_bound(file):
    """In a process of its own, by the largest size it ever had; the result is beside the bound of a network."""
    result = complete([sys.executable, "-c", MEASURED, file])
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) <= 400 + 410 * 520 * 3 * 4 / 2**20


@pytest.mark.parametrize(
    ("file", "device", "message"),
    [
        (FAST, "tensorrt", "device 'tensorrt': this build of ONNX Runtime has only: cpu"),
        (FAST, "abacus", "device 'abacus' is unk"),
        (Path("none.onnx"), "cpu", "no such file"),
    ],
)
def test_devices_and_files_that_are_not_there_are_named_not_replaced(file, device, message):
    """Damaged files: tests/cli/test_refusals.py."""
    with pytest.raises(NgptError, match=message):
        Network(file, device)
