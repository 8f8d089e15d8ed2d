"""The C++ host that calls Open Image Denoise gives the pixels of ``ngpt denoise`` with the networks that correct it.

It is written for OIDN's public header. The library that the Python package mitsuba-oidn has in it is OIDN's, with the
same functions in a namespace and without headers: those that the host calls are declared here, so that both sides run
on one library. It needs the threads that its Python package gives it, so that the host runs in a Python process. Needs
a C++ compiler and ONNX Runtime's headers, too (docs/hosts.md).
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hosts import agree, caller, compiled, read_pfm

import ngpt
from ngpt.export.vector import example_layers
from ngpt.io.rawlayers import write_layers
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

WEIGHTS = Path(ngpt.__file__).parent / "weights"

HEADER = """
#include <cstddef>
namespace mitsuba_oidn {
enum OIDNDeviceType { OIDN_DEVICE_TYPE_CPU = 1 };
enum OIDNFormat { OIDN_FORMAT_FLOAT3 = 3 };
enum OIDNError { OIDN_ERROR_NONE = 0 };
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
void oidnCommitFilter(OIDNFilter filter);
void oidnExecuteFilter(OIDNFilter filter);
void oidnReleaseFilter(OIDNFilter filter);
}
using namespace mitsuba_oidn;
"""

RUNNER = """
import ctypes, sys
import mitsuba_oidn  # gives the library its threads
words = [word.encode() for word in sys.argv[1:]]
sys.exit(ctypes.CDLL(sys.argv[1]).main(len(words), (ctypes.c_char_p * len(words))(*words)))
"""


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    spec = find_spec("mitsuba_oidn")
    if spec is None or spec.origin is None:
        pytest.skip("mitsuba-oidn, which has the library of OIDN in it, is not installed")
    library = Path(spec.origin).parent / "libmitsuba_oidn.so"
    if not library.exists():
        pytest.skip(f"{library} is not there: only Linux has it under that name")
    folder = tmp_path_factory.mktemp("oidn")
    (folder / "OpenImageDenoise").mkdir()
    (folder / "OpenImageDenoise" / "oidn.h").write_text(HEADER)
    flags = ["-shared", "-fPIC", f"-I{folder}", str(library), f"-Wl,-rpath,{library.parent}"]
    return caller([sys.executable, "-c", RUNNER, *compiled("oidn_host.cpp", folder / "ngpt-oidn-host.so", *flags)])


@pytest.fixture(scope="module")
def stack():
    """A folder of layers with all that goes wrong, and their stack; wide, so that there is more than one tile."""
    layers = {name: layer for name, layer in example_layers().items() if not name.startswith("denoised")}
    wide = {name: np.tile(layer, (1, 1, 3, 5)) for name, layer in layers.items()}
    return wide, GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in wide.items()})


@pytest.mark.parametrize("memory", [0, 25])
@pytest.mark.parametrize("method", ["ngpt-combine", "ngpt-primal"])
def test_a_host_with_oidn_gives_the_pixels_of_denoise(host, stack, method, memory, tmp_path):
    layers, held = stack
    write_layers(tmp_path / "layers", layers)
    result = host(WEIGHTS / f"{method}.onnx", tmp_path / "layers", tmp_path / "image.pfm", memory)
    assert result.returncode == 0, result.stderr
    agree(read_pfm(tmp_path / "image.pfm"), reconstruct(held, method).image.transpose(2, 0, 1)[None])


def test_a_host_with_oidn_says_what_is_wrong(host, stack, tmp_path):
    layers, _ = stack
    write_layers(tmp_path / "layers", layers)
    for status, message, *arguments in (
        (2, "usage", WEIGHTS / "ngpt-combine.onnx"),
        (1, "reads no images of OIDN", WEIGHTS / "ngpt-fast.onnx", tmp_path / "layers", tmp_path / "image.pfm"),
    ):
        result = host(*arguments)
        assert result.returncode == status and message in result.stderr and result.stderr.count("\n") == 1, result
