"""All tests of training run on one thread, and so do the fixtures that they share."""

import pytest

torch = pytest.importorskip("torch")


@pytest.fixture(autouse=True)
def quietly(one_thread):
    """All of them on one thread."""


@pytest.fixture(autouse=True, scope="module")
def quiet_fixtures():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
