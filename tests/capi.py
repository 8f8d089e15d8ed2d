"""The C library for tests: built by CMake, and called by ctypes with arrays (H, W, C) of any strides and of halves."""

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
from ctypes import CFUNCTYPE, c_char_p, c_double, c_int, c_size_t, c_ssize_t, c_void_p
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock

import ngpt

SOURCE = Path(__file__).parents[1] / "export" / "capi"
HEADER = SOURCE / "ngpt.h"
WEIGHTS = Path(ngpt.__file__).parent / "weights"
FAST, PRIMAL = WEIGHTS / "ngpt-fast.onnx", WEIGHTS / "ngpt-primal.onnx"
OK, BAD_ARGUMENT, MISSING_LAYER, BAD_NETWORK, OUT_OF_MEMORY, CANCELLED, FAILED = range(7)
FORMATS = {np.dtype(np.float32): 0, np.dtype(np.float16): 1}
PROGRESS = CFUNCTYPE(c_int, c_void_p, c_double)


def command(*arguments, **options) -> str:
    result = subprocess.run(
        [str(a) for a in arguments], capture_output=True, text=True, timeout=500, errors="replace", **options
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def tool(*names) -> str:
    found = next(filter(None, map(shutil.which, names)), None)
    return found or pytest.skip(f"{' and '.join(names)} is not installed")


def headers() -> Path:
    """Where ONNX Runtime is: include/, and lib/ if it is not that of the Python package."""
    root = Path(os.environ.get("ORT_ROOT", "/usr"))
    fetched = SOURCE.parents[1] / "build" / "onnxruntime"
    for folder in (root, fetched):
        if any((folder / name / "onnxruntime_cxx_api.h").exists() for name in ("include", "include/onnxruntime")):
            return folder
    return pytest.skip(f"ONNX Runtime's C++ headers are not in {root}/include: python scripts/headers.py fetches some")


@cache
def built() -> Path:
    """The prefix of the library, which is built once for all processes and runs of a checkout."""
    runtime, name = headers(), hashlib.sha256(str(SOURCE).encode()).hexdigest()[:12]
    folder = SOURCE.parents[1] / "build" / f"capi-{name}"
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / "lock"):
        return install(runtime, folder)


def install(runtime, folder, *options) -> Path:
    """The prefix where the library lies."""
    cmake = tool("cmake")
    tool("g++", "clang++")
    settings = [f"-DORT_ROOT={runtime}", f"-DCMAKE_INSTALL_PREFIX={folder / 'prefix'}", "-DCMAKE_INSTALL_LIBDIR=lib"]
    settings += [f"-DPython3_EXECUTABLE={sys.executable}", "-DCMAKE_CXX_FLAGS=-Werror", *options]
    command(cmake, "-S", SOURCE, "-B", folder / "build", *settings)
    command(cmake, "--build", folder / "build", "--parallel", 2)
    command(cmake, "--install", folder / "build")
    return folder / "prefix"


def load(path) -> ctypes.CDLL:
    """The library, its functions with their types."""
    library = ctypes.CDLL(str(path))
    place = (c_void_p, c_int, c_int, c_ssize_t, c_ssize_t, c_ssize_t)
    types = {
        "version": (c_char_p,),
        "abi": (c_int,),
        "open": (c_void_p, c_char_p, c_int, c_char_p, c_size_t),
        "open_on": (c_void_p, c_char_p, c_char_p, c_int, c_char_p, c_size_t),
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
        "set_output": (c_int, c_void_p, c_char_p, *place),
        "prepare": (c_int, c_void_p, c_int, c_int, PROGRESS, c_void_p),
        "run": (c_int, c_void_p, c_int, c_int, c_int, PROGRESS, c_void_p),
    }
    for name, (result, *arguments) in types.items():
        function = getattr(library, f"ngpt_{name}")
        function.restype, function.argtypes = result, arguments
    return library


class Network:
    """An open network; the handle is None, and ``message`` says why, where it cannot be opened."""

    def __init__(self, library, path=FAST, threads=1, device=None):
        self.library, message = library, ctypes.create_string_buffer(512)
        device = None if device is None else device.encode()
        self.handle = library.ngpt_open_on(device, str(path).encode(), threads, message, len(message))
        self.message = message.value.decode(errors="replace")
        self.names = [library.ngpt_layer_name(self.handle, i).decode(errors="replace") for i in range(self.count())]

    def count(self):
        return self.library.ngpt_layer_count(self.handle)

    def close(self):
        self.library.ngpt_close(self.handle)
        self.handle = None

    __del__ = close


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
        self.set(layers)

    def set(self, layers):
        for name, layer in layers.items():
            assert self.set_layer(name, *place(layer)) == OK, self.message()
        assert self.set_output("image", *place(self.image)) == OK

    def set_layer(self, name, *where):
        return self.library.ngpt_set_layer(self.handle, name.encode(), *where)

    def set_output(self, name, *where):
        return self.library.ngpt_set_output(self.handle, name.encode(), *where)

    def message(self):
        return self.library.ngpt_message(self.handle).decode()

    def run(self, memory=0, progress=None, size=None):
        function = PROGRESS(lambda _, fraction: progress(fraction)) if progress else PROGRESS()
        return self.library.ngpt_run(self.handle, *(size or (self.width, self.height)), memory, function, None)

    def prepare(self, size=None):
        return self.library.ngpt_prepare(self.handle, *(size or (self.width, self.height)), PROGRESS(), None)

    def __del__(self):
        self.library.ngpt_job_free(self.handle)


def result(network, layers, memory=0, image=None, progress=None) -> np.ndarray:
    job = Job(network, layers, image)
    assert job.run(memory, progress) == OK and job.message() == "", job.message()
    return job.image


def example(height=23, width=29) -> dict[str, np.ndarray]:
    """Layers (H, W, C) of every kind; larger ones are the vector's again and again, brighter to the right."""
    pytest.importorskip("onnx")
    from ngpt.export.vector import example_layers

    brightness, layers = np.exp2(4 * np.arange(width) / width), {}
    for name, layer in example_layers().items():
        power = 2 if name.endswith("_var") else 0 if name in ("albedo", "normal", "depth") else 1
        many = np.tile(layer[0], (1, -(-height // 23), -(-width // 29)))[:, :height, :width]
        layers[name] = np.ascontiguousarray(np.moveaxis(many * brightness**power, 0, -1), np.float32)
    return layers


def those(network, layers):
    """The layers that the network reads."""
    return {name: layers[name] for name in network.names if name in layers}


def in_python(path):
    """A function: what ONNX Runtime in Python makes of all layers at once."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def run(layers) -> np.ndarray:
        feed = {name: np.ascontiguousarray(np.moveaxis(layer, -1, 0)[None]) for name, layer in layers.items()}
        return np.moveaxis(session.run(["image"], feed)[0][0], 0, -1)

    return run


def agree(image, expected, tolerance=1e-5):
    """To a part of each value and of the typical one: a lamp is no excuse for what is beside."""
    assert image.shape == expected.shape
    assert (np.abs(image - expected) <= tolerance * (np.abs(expected) + np.median(np.abs(expected)))).all()
