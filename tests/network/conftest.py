"""Shared by the tests of the network."""

import pytest

pytest.importorskip("torch")


@pytest.fixture(autouse=True)
def quietly(one_thread):
    """All of them on one thread."""
