"""Hosts in other languages, built and run by tests; skips where what they need is not here."""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from capi import built, command, example, tool

from ngpt.stack import GradientStack

HOSTS = Path(__file__).parents[1] / "export" / "hosts"
VECTOR = HOSTS.parent / "vector"

# mitsuba-oidn has OIDN's library in it, with the same functions in a namespace, and without headers: those that the
# host calls, so that it and ngpt run on one library. The library has no threads but those of its Python package, so
# that the host, as a shared library, runs in a Python process.
_OIDN = """
#include <cstddef>
namespace mitsuba_oidn {
enum OIDNDeviceType { OIDN_DEVICE_TYPE_CPU = 1 };
enum OIDNFormat { OIDN_FORMAT_FLOAT3 = 3 };
enum OIDNError { OIDN_ERROR_NONE = 0 };
enum OIDNQuality { OIDN_QUALITY_FAST = 4, OIDN_QUALITY_BALANCED = 5, OIDN_QUALITY_HIGH = 6 };
typedef struct OIDNDeviceImpl *OIDNDevice;
typedef struct OIDNFilterImpl *OIDNFilter;
OIDNDevice oidnNewDevice(OIDNDeviceType type);
void oidnCommitDevice(OIDNDevice device);
void oidnReleaseDevice(OIDNDevice device);
OIDNError oidnGetDeviceError(OIDNDevice device, const char **message);
OIDNFilter oidnNewFilter(OIDNDevice device, const char *type);
void oidnSetSharedFilterImage(OIDNFilter filter, const char *name, void *data, OIDNFormat format, size_t width,
                              size_t height, size_t byteOffset, size_t pixelByteStride, size_t rowByteStride);
void oidnSetFilterBool(OIDNFilter filter, const char *name, bool value);
void oidnSetFilterInt(OIDNFilter filter, const char *name, int value);
void oidnCommitFilter(OIDNFilter filter);
void oidnExecuteFilter(OIDNFilter filter);
void oidnReleaseFilter(OIDNFilter filter);
}
using namespace mitsuba_oidn;
"""

_IN_PYTHON = """
import ctypes, sys
import mitsuba_oidn  # gives the library its threads
words = [word.encode() for word in sys.argv[1:]]
sys.exit(ctypes.CDLL(sys.argv[1]).main(len(words), (ctypes.c_char_p * len(words))(*words)))
"""


def read_layers(folder) -> dict[str, np.ndarray]:
    """The layers (1, C, H, W) that a folder of raw files holds, as ``export/vector`` does."""
    shapes = {name: item["shape"] for name, item in json.loads((folder / "layers.json").read_text()).items()}
    return {name: np.fromfile(folder / f"{name}.f32", "<f4").reshape(shape) for name, shape in shapes.items()}


def repeated(height, width) -> dict[str, np.ndarray]:
    """The layers of ``capi.example`` as hosts read them, (1, C, H, W)."""
    layers = {name: layer for name, layer in example(height, width).items() if "denoised" not in name}
    return {name: np.ascontiguousarray(np.moveaxis(layer, -1, 0)[None]) for name, layer in layers.items()}


def stack_of(layers) -> GradientStack:
    return GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})


def read_pfm(path) -> np.ndarray:
    """A portable float map as (1, 3, H, W)."""
    kind, size, scale, pixels = path.read_bytes().split(b"\n", 3)
    assert (kind, scale) == (b"PF", b"-1.0")
    width, height = map(int, size.split())
    return np.frombuffer(pixels, "<f4").reshape(height, width, 3)[::-1].transpose(2, 0, 1)[None]


def agree(image, expected):
    """To 1e-4 of each value, and of the darkest to 1e-6 of the typical one: a lamp is no excuse for what is beside."""
    assert image.shape == expected.shape
    assert (np.abs(image - expected) <= 1e-4 * (np.abs(expected) + 1e-2 * np.median(np.abs(expected)))).all()


def agree_but_for_rounding_in_oidn(image, expected):
    """As ``agree``, for networks that read OIDN's image of the base: 1e-4 on average, 2e-2 at worst, relative.

    On CPUs with bfloat16 OIDN rounds to it: of bases that differ in their last bit it makes images that differ by
    2^-8 in some values. No host has the base of NumPy to the last bit.
    """
    error = np.abs(image - expected) / (np.abs(expected) + 1e-2 * np.median(np.abs(expected)))
    assert error.mean() <= 1e-4 and error.max() <= 2e-2, (error.mean(), error.max())


def compiled(source: str, folder: Path, *flags: str) -> list[str]:
    """The command of a C++ host, compiled with libngpt in a folder."""
    prefix, program = built(), folder / Path(source).stem
    strict = [tool("g++", "clang++"), "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror"]
    library = [f"-I{prefix}/include", f"-L{prefix}/lib", f"-Wl,-rpath,{prefix}/lib", "-lngpt"]
    command(*strict, HOSTS / "cpp" / source, "-o", program, *library, *flags)
    return [str(program)]


def cpp_host(folder) -> list[str]:
    return compiled("host.cpp", folder)


def node_modules(package, host) -> Path:
    folders = [*filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep)), HOSTS / host / "node_modules"]
    found = next((Path(folder) / package for folder in folders if (Path(folder) / package).is_dir()), None)
    if found is None:
        pytest.skip(f"{package} is neither in NODE_PATH nor in export/hosts/{host}/node_modules; npm install {package}")
    return found


def node() -> str:
    return shutil.which("node") or pytest.skip("node is not installed")


def node_host(_folder) -> list[str]:
    node_modules("onnxruntime-node", "node")
    return [node(), str(HOSTS / "node" / "host.mjs")]


def caller(command):
    """A function that runs a host with arguments of any type."""
    return lambda *arguments: subprocess.run(
        [*command, *map(str, arguments)], capture_output=True, text=True, timeout=500
    )


def oidn_host(folder) -> list[str]:
    spec = find_spec("mitsuba_oidn")
    if spec is None or spec.origin is None:
        pytest.skip("mitsuba-oidn, which has the library of OIDN in it, is not installed")
    library = Path(spec.origin).parent / "libmitsuba_oidn.so"
    if not library.exists():
        pytest.skip(f"{library} is not there: only Linux has it under that name")
    (folder / "OpenImageDenoise").mkdir()
    (folder / "OpenImageDenoise" / "oidn.h").write_text(_OIDN)
    flags = ["-shared", "-fPIC", f"-I{folder}", str(library), f"-Wl,-rpath,{library.parent}"]
    return [sys.executable, "-c", _IN_PYTHON, *compiled("oidn_host.cpp", folder, *flags)]
