"""All tests of the network run on one thread."""

import pytest

pytest.importorskip("torch")


@pytest.fixture(autouse=True)
def quietly(one_thread):
    """All of them on one thread."""
