"""Fixtures of the C library; it wants a compiler, CMake and ONNX Runtime's headers, see docs/embed/c-library.md."""

import pytest
from capi import PRIMAL, Network, built, load


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


def pytest_collection_modifyitems(items):
    """Hosts know nothing yet of light below 0, which ``ngpt denoise`` keeps since November 28."""
    import pytest

    for item in items:
        if "wide-oidn_host-ngpt-combine" in item.nodeid:
            item.add_marker(pytest.mark.xfail(reason="hosts do not keep light below 0", strict=False))
