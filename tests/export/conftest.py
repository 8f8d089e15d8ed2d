"""Fixtures of the C library; it wants a compiler, CMake and ONNX Runtime's headers, see docs/embed/c-library.md."""

from pathlib import Path

import pytest
from capi import PRIMAL, Network, headers, install, load


@pytest.fixture(scope="session")
def runtime() -> Path:
    """Where ONNX Runtime is."""
    return headers()


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
