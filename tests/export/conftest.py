"""Fixtures of the C library; it wants a compiler, CMake and ONNX Runtime's headers, see docs/embed/c-library.md."""

import os
from pathlib import Path

import pytest
from capi import PRIMAL, Network, install, load


@pytest.fixture(scope="session")
def runtime(tmp_path_factory) -> Path:
    """A folder with include/ and lib/ of ONNX Runtime."""
    root = Path(os.environ.get("ORT_ROOT", "/usr"))
    if not any((root / folder / "onnxruntime_cxx_api.h").exists() for folder in ("include", "include/onnxruntime")):
        pytest.skip(f"ONNX Runtime's C++ headers are not in {root}/include; name a release's folder in ORT_ROOT")
    if root == Path("/usr") or (root / "lib" / "libonnxruntime.so").exists():
        return root
    ort = pytest.importorskip("onnxruntime")
    library = next(Path(ort.__file__).parent.glob("capi/libonnxruntime.so.1.*"), None)
    if library is None:
        pytest.skip(f"there is no libonnxruntime.so in {root}/lib, nor in the Python package")
    folder = tmp_path_factory.mktemp("onnxruntime")
    (folder / "lib").mkdir()
    (folder / "include").symlink_to(root / "include")
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / "lib" / name).symlink_to(library)
    return folder


@pytest.fixture(scope="session")
def prefix(runtime, tmp_path_factory):
    return install(runtime, tmp_path_factory.mktemp("capi"))


@pytest.fixture(scope="session")
def library(prefix):
    return load(prefix / "lib" / "libngpt.so")


@pytest.fixture(scope="session")
def fast(library):
    network = Network(library)
    yield network
    network.close()


@pytest.fixture(scope="session")
def primal(library):
    network = Network(library, PRIMAL)
    yield network
    network.close()
