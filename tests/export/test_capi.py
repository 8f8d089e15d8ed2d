"""The C library: built by CMake, installed, found by find_package, and called from C, C++ and Python.

It wants a compiler, CMake, and ONNX Runtime's headers, of the system or in ORT_ROOT; see docs/c-library.md. Where there
is no library beside the headers, that of the Python package is taken.
"""

import ctypes
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_ssize_t, c_void_p
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ngpt

ort = pytest.importorskip("onnxruntime")

ROOT = Path(__file__).parents[2]
SOURCE, VECTOR, WEIGHTS = ROOT / "export" / "capi", ROOT / "export" / "vector", Path(ngpt.__file__).parent / "weights"
HEADER = SOURCE / "ngpt.h"
FAST, COLOUR = WEIGHTS / "ngpt-fast.onnx", WEIGHTS / "ngpt-colour.onnx"
OK, BAD_ARGUMENT, MISSING_LAYER, BAD_NETWORK, OUT_OF_MEMORY, CANCELLED = range(6)
FORMATS = {np.dtype(np.float32): 0, np.dtype(np.float16): 1}
PROGRESS = CFUNCTYPE(c_int, c_void_p, c_double)


# --- building --------------------------------------------------------------------------------------------------------


def command(*arguments, **options) -> str:
    result = subprocess.run(
        [str(a) for a in arguments], capture_output=True, text=True, timeout=500, errors="replace", **options
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def tool(*names) -> str:
    found = next(filter(None, map(shutil.which, names)), None)
    return found or pytest.skip(f"{' and '.join(names)} is not installed")


@pytest.fixture(scope="module")
def runtime(tmp_path_factory) -> Path:
    """A folder with include/ and lib/ of ONNX Runtime."""
    root = Path(os.environ.get("ORT_ROOT", "/usr"))
    if not any((root / folder / "onnxruntime_cxx_api.h").exists() for folder in ("include", "include/onnxruntime")):
        pytest.skip(f"ONNX Runtime's C++ headers are not in {root}/include; name a release's folder in ORT_ROOT")
    if root == Path("/usr") or (root / "lib" / "libonnxruntime.so").exists():
        return root
    library = next(Path(ort.__file__).parent.glob("capi/libonnxruntime.so.1.*"), None)
    if library is None:
        pytest.skip(f"there is no libonnxruntime.so in {root}/lib, nor in the Python package")
    folder = tmp_path_factory.mktemp("onnxruntime")
    (folder / "lib").mkdir()
    (folder / "include").symlink_to(root / "include")
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / "lib" / name).symlink_to(library)
    return folder


def install(runtime, folder, *options) -> Path:
    """The prefix where the library lies."""
    cmake = tool("cmake")
    tool("g++", "clang++")
    settings = [f"-DORT_ROOT={runtime}", f"-DCMAKE_INSTALL_PREFIX={folder / 'prefix'}", "-DCMAKE_INSTALL_LIBDIR=lib"]
    settings += ["-DCMAKE_CXX_FLAGS=-Werror", *options]
    command(cmake, "-S", SOURCE, "-B", folder / "build", *settings)
    command(cmake, "--build", folder / "build", "--parallel", 2)
    command(cmake, "--install", folder / "build")
    return folder / "prefix"


@pytest.fixture(scope="module")
def prefix(runtime, tmp_path_factory):
    return install(runtime, tmp_path_factory.mktemp("capi"))


@pytest.fixture(scope="module")
def library(prefix):
    library = ctypes.CDLL(str(next(prefix.glob("lib/libngpt.so"))))
    place = (c_void_p, c_int, c_int, c_ssize_t, c_ssize_t, c_ssize_t)
    types = {
        "version": (c_char_p,),
        "abi": (c_int,),
        "open": (c_void_p, c_char_p, c_int, c_char_p, c_size_t),
        "close": (None, c_void_p),
        "layer_count": (c_int, c_void_p),
        "layer_name": (c_char_p, c_void_p, c_int),
        "layer_channels": (c_int, c_void_p, c_int),
        "layer_required": (c_int, c_void_p, c_int),
        "metadata": (c_char_p, c_void_p, c_char_p),
        "job_new": (c_void_p, c_void_p),
        "job_free": (None, c_void_p),
        "message": (c_char_p, c_void_p),
        "set_layer": (c_int, c_void_p, c_char_p, *place),
        "set_output": (c_int, c_void_p, *place),
        "run": (c_int, c_void_p, c_int, c_int, c_int, PROGRESS, c_void_p),
    }
    for name, (result, *arguments) in types.items():
        function = getattr(library, f"ngpt_{name}")
        function.restype, function.argtypes = result, arguments
    return library


# --- calling ---------------------------------------------------------------------------------------------------------


class Network:
    def __init__(self, library, path=FAST, threads=1):
        self.library, message = library, ctypes.create_string_buffer(512)
        self.handle = library.ngpt_open(str(path).encode(), threads, message, len(message))
        self.message = message.value.decode()
        self.names = [library.ngpt_layer_name(self.handle, i).decode() for i in range(self.count())]

    def count(self):
        return self.library.ngpt_layer_count(self.handle)

    def close(self):
        self.library.ngpt_close(self.handle)


def place(array) -> tuple:
    """An array (H, W, C) in memory, as the C functions are told."""
    row, pixel, channel = array.strides
    return array.ctypes.data, FORMATS[array.dtype], array.shape[2], channel, pixel, row


class Job:
    """A job with the layers (H, W, C) set, its image in ``image``."""

    def __init__(self, network, layers, image=None):
        self.library, self.layers = network.library, layers
        self.height, self.width = layers["primal"].shape[:2]
        self.image = np.full((self.height, self.width, 3), -7, np.float32) if image is None else image
        self.handle = self.library.ngpt_job_new(network.handle)
        for name, layer in layers.items():
            assert self.library.ngpt_set_layer(self.handle, name.encode(), *place(layer)) == OK, self.message()
        assert self.library.ngpt_set_output(self.handle, *place(self.image)) == OK

    def message(self):
        return self.library.ngpt_message(self.handle).decode()

    def run(self, memory=0, progress=None):
        function = PROGRESS(lambda _, fraction: progress(fraction)) if progress else PROGRESS()
        return self.library.ngpt_run(self.handle, self.width, self.height, memory, function, None)

    def free(self):
        self.library.ngpt_job_free(self.handle)


def result(network, layers, memory=0, image=None, progress=None) -> np.ndarray:
    job = Job(network, layers, image)
    try:
        assert job.run(memory, progress) == OK, job.message()
        assert job.message() == ""
        return job.image
    finally:
        job.free()


@pytest.fixture(scope="module")
def fast(library):
    network = Network(library)
    yield network
    network.close()


@pytest.fixture(scope="module")
def colour(library):
    network = Network(library, COLOUR)
    yield network
    network.close()


def example(height=23, width=29) -> dict[str, np.ndarray]:
    """Layers (H, W, C) of every kind; larger ones are the vector's again and again, brighter to the right."""
    from ngpt.export.vector import example_layers

    brightness, layers = np.exp2(4 * np.arange(width) / width), {}
    for name, layer in example_layers().items():
        power = 2 if name.endswith("_var") else 0 if name in ("albedo", "normal", "depth") else 1
        many = np.tile(layer[0], (1, -(-height // 23), -(-width // 29)))[:, :height, :width]
        layers[name] = np.ascontiguousarray(np.moveaxis(many * brightness**power, 0, -1), np.float32)
    return layers


def those(network, layers):
    return {name: layers[name] for name in network.names if name in layers}


def in_python(path, layers) -> np.ndarray:
    """What ONNX Runtime in Python makes of all the layers at once."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    feed = {name: np.ascontiguousarray(np.moveaxis(layer, -1, 0)[None]) for name, layer in layers.items()}
    return np.moveaxis(session.run(["image"], feed)[0][0], 0, -1)


def agree(image, expected, tolerance=1e-5):
    assert image.shape == expected.shape
    assert np.abs(image - expected).max() <= tolerance * np.abs(expected).max()


# --- what it makes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(WEIGHTS.glob("ngpt-*[a-z].onnx")), ids=lambda path: path.stem)
def test_networks_agree_with_python(library, path):
    if path.stem.endswith(".statistics"):
        return
    network = Network(library, path)
    layers = those(network, example())
    agree(result(network, layers), in_python(path, layers))
    network.close()


def test_the_vector(fast):
    from ngpt.export.vector import example_layers

    image = np.fromfile(VECTOR / "image.f32", "<f4").reshape(3, 23, 29)
    layers = {
        name: np.moveaxis(np.fromfile(VECTOR / f"{name}.f32", "<f4").reshape(layer.shape)[0], 0, -1)
        for name, layer in example_layers().items()
        if name in fast.names
    }
    agree(result(fast, layers), np.moveaxis(image, 0, -1))


@pytest.mark.parametrize(("height", "width", "memory"), [(23, 700, 60), (330, 331, 250)])
def test_tiles_agree_with_the_whole(fast, height, width, memory):
    layers = those(fast, example(height, width))
    whole, fractions = result(fast, layers), []
    tiled = result(fast, layers, memory, progress=lambda fraction: fractions.append(fraction) or 0)
    assert len(set(fractions)) > 2
    agree(tiled, whole)


def test_the_tiles_are_those_of_python(colour):
    from ngpt.network.run_onnx import Network as InPython

    layers = those(colour, example(200, 300))
    fractions = []
    result(colour, layers, 40, progress=lambda fraction: fractions.append(fraction) or 0)
    tiles, _ = InPython(COLOUR).plan(200, 300, 40)
    assert len(set(fractions)) == len(tiles) + 1 > 3


def test_sizes_from_one_pixel(fast):
    for height, width in ((1, 1), (1, 40), (17, 1), (16, 16)):
        layers = those(fast, example(height, width))
        agree(result(fast, layers), in_python(FAST, layers))


def test_a_base_may_be_given(fast):
    assert "base" in fast.names and "statistics" not in fast.names
    layers = example()
    base = 0.8 * layers["primal"]
    agree(
        result(fast, those(fast, layers) | {"base": base}), in_python(FAST, those(fast, layers) | {"base": base})
    )
    assert np.abs(result(fast, those(fast, layers)) - result(fast, those(fast, layers) | {"base": base})).max() > 1e-3


def test_layers_that_are_not_there(fast, colour):
    layers = those(fast, example())
    without = {name: layer for name, layer in layers.items() if not name.endswith("_var")}
    unknown = {name: np.full_like(layer, -1) for name, layer in layers.items() if name.endswith("_var")}
    agree(result(fast, without), in_python(FAST, without | unknown))
    layers = those(colour, example())
    zeros = {name: np.zeros_like(layer) for name, layer in layers.items() if name != "primal"}
    agree(result(colour, {"primal": layers["primal"]}), in_python(COLOUR, layers | zeros))


def test_a_layer_can_be_taken_away(library, colour):
    layers = those(colour, example())
    job = Job(colour, layers)
    assert library.ngpt_set_layer(job.handle, b"albedo", None, 0, 0, 0, 0, 0) == OK
    assert job.run() == OK
    agree(job.image, result(colour, {name: layer for name, layer in layers.items() if name != "albedo"}))
    assert library.ngpt_set_layer(job.handle, b"primal", None, 0, 0, 0, 0, 0) == OK
    assert job.run() == MISSING_LAYER and "primal" in job.message()
    job.free()


# --- where pixels lie ------------------------------------------------------------------------------------------------


def odd_address(array):
    room = np.zeros(array.nbytes + 1, np.uint8)[1:].view()
    room[:] = np.frombuffer(array.tobytes(), np.uint8)
    return np.ndarray(array.shape, array.dtype, room.data)


def crop(array):
    height, width, channels = array.shape
    large = np.full((height + 5, width + 7, channels + 1), 99, array.dtype)
    large[2 : height + 2, 3 : width + 3, :channels] = array
    return large[2 : height + 2, 3 : width + 3, :channels]


LAYOUTS = {
    "planes": lambda a: np.moveaxis(np.ascontiguousarray(np.moveaxis(a, -1, 0)), 0, -1),
    "from the bottom": lambda a: np.ascontiguousarray(a[::-1])[::-1],
    "columns": lambda a: np.asfortranarray(a),
    "part of a larger image": crop,
    "more channels": lambda a: np.concatenate([a, np.full_like(a[..., :1], 99)], axis=-1),
    "BGR": lambda a: np.ascontiguousarray(a[..., ::-1])[..., ::-1],
    "odd addresses": odd_address,
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_give_the_same(fast, layout):
    layers = those(fast, example())
    expected = result(fast, layers)
    before = {name: layout(layer) for name, layer in layers.items()}
    given = {name: layer.copy() for name, layer in before.items()}
    image = layout(np.full(expected.shape, 7, np.float32))
    np.testing.assert_array_equal(result(fast, before, image=image)[..., :3], expected)
    assert (image[..., 3:] == 99).all()
    assert all((before[name] == given[name]).all() for name in given)


def test_strides_of_nought_are_those_without_gaps(library, fast):
    layers = those(fast, example())
    job = Job(fast, layers)
    for name, layer in layers.items():
        data, form, channels, *_ = place(layer)
        assert library.ngpt_set_layer(job.handle, name.encode(), data, form, channels, 0, 0, 0) == OK
    assert library.ngpt_set_output(job.handle, job.image.ctypes.data, 0, 3, 0, 0, 0) == OK
    assert job.run() == OK
    np.testing.assert_array_equal(job.image, result(fast, layers))
    job.free()


def test_halves(colour):
    values = np.concatenate([np.arange(2**16, dtype=np.uint16).view(np.float16), np.zeros(32, np.float16)])
    finite = np.where(np.isfinite(values), values, 0).reshape(-1, 32, 3)[:600] if len(values) % 96 == 0 else None
    if finite is None:
        finite = np.where(np.isfinite(values), values, 0)[: 96 * 682].reshape(-1, 32, 3)
    expected = result(colour, {"primal": finite.astype(np.float32)})
    np.testing.assert_array_equal(result(colour, {"primal": finite}), expected)
    halves = result(colour, {"primal": finite}, image=np.zeros(finite.shape, np.float16))
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(halves, expected.astype(np.float16))


def test_the_output_may_lie_where_a_layer_is(fast):
    layers = those(fast, example(23, 700))
    expected = result(fast, layers, 60)
    np.testing.assert_array_equal(result(fast, layers, 60, image=layers["primal"]), expected)


# --- what is wrong ---------------------------------------------------------------------------------------------------


def test_null_everywhere(library, fast):
    message = ctypes.create_string_buffer(64)
    assert library.ngpt_open(None, 0, message, 64) is None and b"NULL" in message.value
    assert library.ngpt_open(None, 0, None, 0) is None
    library.ngpt_close(None)
    library.ngpt_job_free(None)
    assert library.ngpt_layer_count(None) == 0 and library.ngpt_layer_name(None, 0) is None
    assert library.ngpt_layer_channels(None, 0) == 0 and library.ngpt_layer_required(None, 0) == 0
    assert library.ngpt_metadata(None, b"ngpt.method") is None and library.ngpt_metadata(fast.handle, None) is None
    assert library.ngpt_job_new(None) is None and library.ngpt_message(None)
    assert library.ngpt_set_layer(None, b"primal", None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_set_output(None, None, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    assert library.ngpt_run(None, 1, 1, 0, PROGRESS(), None) == BAD_ARGUMENT
    job = library.ngpt_job_new(fast.handle)
    assert library.ngpt_set_layer(job, None, message, 0, 3, 0, 0, 0) == BAD_ARGUMENT
    library.ngpt_job_free(job)


def test_the_network_is_described(library, fast, colour):
    assert fast.names[:9] == "primal dx dy albedo normal depth primal_var dx_var dy_var".split()
    about = {
        name: (library.ngpt_layer_channels(fast.handle, i), library.ngpt_layer_required(fast.handle, i))
        for i, name in enumerate(fast.names)
    }
    assert about["primal"] == about["normal"] == (3, 1) and about["depth"] == (1, 1)
    assert about["dx_var"] == about["base"] == (3, 0)
    assert colour.names == ["primal", "albedo", "normal"]
    assert [library.ngpt_layer_required(colour.handle, i) for i in range(3)] == [1, 0, 0]
    for index in (-1, fast.count()):
        assert library.ngpt_layer_name(fast.handle, index) is None
        assert library.ngpt_layer_channels(fast.handle, index) == library.ngpt_layer_required(fast.handle, index) == 0
    assert library.ngpt_metadata(fast.handle, b"ngpt.method") == b"ngpt-fast"
    assert library.ngpt_metadata(fast.handle, b"no such key") is None
    assert library.ngpt_version().decode() == ngpt.__version__
    assert library.ngpt_abi() == int(re.search(r"define NGPT_ABI (\d+)", HEADER.read_text())[1])


def refused(status, expected, job, words):
    assert status == expected, job.message()
    assert re.search(words, job.message()) and "\n" not in job.message()
    assert (job.image == -7).all()


def test_what_a_job_refuses(library, fast):
    layers = those(fast, example())
    job, primal = Job(fast, layers), place(layers["primal"])
    handle = job.handle
    refused(library.ngpt_set_layer(handle, b"beauty", *primal), BAD_ARGUMENT, job, "'beauty'; it reads primal, dx")
    refused(library.ngpt_set_layer(handle, b"x" * 9999, *primal), BAD_ARGUMENT, job, "xxx")
    refused(library.ngpt_set_layer(handle, b"statistics", *primal), BAD_ARGUMENT, job, "statistics")
    refused(
        library.ngpt_set_layer(handle, b"albedo", *place(layers["depth"])), BAD_ARGUMENT, job, "albedo: has 1 .* have 3"
    )
    refused(library.ngpt_set_layer(handle, b"albedo", primal[0], 5, *primal[2:]), BAD_ARGUMENT, job, "format is 5")
    refused(library.ngpt_set_output(handle, primal[0], 0, 2, 0, 0, 0), BAD_ARGUMENT, job, "output: has 2")
    for size in ((0, 5), (5, -1), (65537, 1)):
        refused(
            library.ngpt_run(handle, *size, 0, PROGRESS(), None), BAD_ARGUMENT, job, f"{size[0]}x{size[1]} .* 65536"
        )
    refused(library.ngpt_run(handle, 29, 23, -3, PROGRESS(), None), BAD_ARGUMENT, job, "-3 MiB")
    assert job.run() == OK and job.message() == ""
    job.free()


def test_what_is_missing(library, fast):
    layers = those(fast, example())
    job = Job(fast, {name: layer for name, layer in layers.items() if name not in ("dx", "depth")})
    refused(job.run(), MISSING_LAYER, job, "needs the layers dx, depth")
    job.free()
    job = Job(fast, layers)
    assert library.ngpt_set_output(job.handle, None, 0, 3, 0, 0, 0) == OK
    refused(job.run(), MISSING_LAYER, job, "output")
    job.free()


def test_too_little_memory(fast):
    job = Job(fast, those(fast, example(400, 400)))
    refused(job.run(1), OUT_OF_MEMORY, job, "smallest tile takes 2.. MiB, and 1 MiB")
    job.free()


def test_damaged_networks(library, tmp_path):
    data = FAST.read_bytes()
    wrong = {
        "none": None,
        "empty": b"",
        "text": b"not a network",
        "cut": data[: len(data) // 2],
        "head": data[:100],
        "statistics": FAST.with_suffix(".statistics.onnx").read_bytes(),
        "alignment": data.replace(b"ngpt.alignment\x12\x0216", b"ngpt.alignment\x12\x02-8"),
        "layers": data.replace(b"primal, dx, dy, albedo", b"primal, dx, dy, albino"),
        "fewer": data.replace(b", depth, primal_var", b", dx_var, dy_var  "),
        "metadata": data.replace(b"ngpt.inputs", b"ngpt.outputs"[:11]),
    }
    for name, content in wrong.items():
        path = tmp_path / f"{name}.onnx"
        if content is not None:
            path.write_bytes(content)
        network = Network(library, path)
        assert network.handle is None and network.message.startswith(str(path)), (name, network.message)
        assert "\n" not in network.message
    rng = np.random.default_rng(5)
    for _ in range(20):
        bytes_ = np.frombuffer(data, np.uint8).copy()
        bytes_[rng.integers(0, len(data), 50)] = rng.integers(0, 256, 50)
        (tmp_path / "mutant.onnx").write_bytes(bytes_.tobytes())
        network = Network(library, tmp_path / "mutant.onnx")
        assert (network.handle is None) == bool(network.message)
        network.close()
    assert Network(library, FAST, threads=-1).message == "the number of threads is -1; it must be 0 or more"


def test_messages_fit_where_they_go(library, tmp_path):
    for size in (0, 1, 2, 20):
        message = ctypes.create_string_buffer(b"?" * 30)
        assert library.ngpt_open(str(tmp_path / "none.onnx").encode(), 0, message, size) is None
        assert message.raw[max(size - 1, 0) : size] == b"\0" * min(size, 1) and message.raw[size:30] == b"?" * (30 - size)


def test_tiles_need_the_statistics(library, tmp_path):
    alone = tmp_path / "ngpt-fast.onnx"
    shutil.copy(FAST, alone)
    network = Network(library, alone)
    job = Job(network, those(network, example(23, 700)))
    refused(job.run(60), BAD_NETWORK, job, "ngpt-fast.statistics.onnx: cannot be read.* tiles need it")
    assert job.run() == OK
    job.free()
    network.close()
    other = WEIGHTS / "ngpt-fast.statistics.onnx"
    shutil.copy(COLOUR, tmp_path / "other.onnx")
    shutil.copy(other, tmp_path / "other.statistics.onnx")
    network = Network(library, tmp_path / "other.onnx")
    job = Job(network, those(network, example(200, 300)))
    refused(job.run(40), BAD_NETWORK, job, "belongs to another network, it reads depth")
    job.free()
    network.close()


def test_paths_of_any_letters(library, tmp_path):
    folder = tmp_path / "Größe 大"
    folder.mkdir()
    shutil.copy(COLOUR, folder / "network")
    network = Network(library, folder / "network")
    assert network.handle, network.message
    network.close()


# --- progress, threads, time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_cancelled_after_so_many_tiles(fast, after):
    job, fractions = Job(fast, those(fast, example(23, 700))), []

    def progress(fraction):
        fractions.append(fraction)
        return len(set(fractions)) > after

    refused(job.run(60, progress), CANCELLED, job, "^cancelled$")
    assert fractions == sorted(fractions) and len(set(fractions)) == after + 1
    assert job.run(60) == OK and (job.image != -7).any()
    job.free()


def test_a_tile_is_cancelled_in_the_middle(fast):
    layers = those(fast, example(500, 500))
    start = time.perf_counter()
    result(fast, layers)
    whole = time.perf_counter() - start
    job, start = Job(fast, layers), time.perf_counter()
    refused(job.run(0, lambda _: int(time.perf_counter() - start > 0.1 * whole)), CANCELLED, job, "cancelled")
    assert time.perf_counter() - start < 0.6 * whole
    job.free()


def test_progress_comes_from_the_callers_thread(fast):
    callers = []
    result(fast, those(fast, example()), progress=lambda _: callers.append(threading.get_ident()) or 0)
    assert set(callers) == {threading.get_ident()} and len(callers) >= 2


def test_threads_share_a_network(fast):
    inputs = [those(fast, example(40 + 3 * i, 90)) for i in range(4)]
    expected, wrong = [result(fast, layers) for layers in inputs], []

    def work(layers, image):
        for _ in range(5):
            if not np.array_equal(result(fast, layers), image):
                wrong.append(layers)

    threads = [threading.Thread(target=work, args=pair) for pair in zip(inputs, expected, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_threads_open_networks(library):
    networks: list = []
    threads = [threading.Thread(target=lambda: networks.append(Network(library, COLOUR))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(networks) == 4 and all(network.handle for network in networks)
    for network in networks:
        network.close()


def test_a_job_outlives_its_network(library):
    network = Network(library, COLOUR)
    job = Job(network, those(network, example()))
    network.close()
    assert job.run() == OK and (job.image != -7).any()
    job.free()
