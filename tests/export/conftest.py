"""Fixtures of the C library; it wants a compiler, CMake and ONNX Runtime's headers, see docs/embed/c-library.md."""

from unittest.mock import patch

import pytest
from capi import PRIMAL, Network, built, load


@pytest.fixture(scope="session", autouse=True)
def one_example():
    """How far a network sees is measured on one example: that takes most of the time of an export."""
    with patch("ngpt.export.reach.EXAMPLES", 1):
        yield


@pytest.fixture(scope="session")
def prefix(toolchain):
    return built()


@pytest.fixture(scope="session")
def library(prefix):
    return load(prefix / "lib" / "libngpt.so")


@pytest.fixture(scope="session")
def fast(library):
    return Network(library)


@pytest.fixture(scope="session")
def primal(library):
    return Network(library, PRIMAL)
