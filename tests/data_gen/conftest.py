"""Fixtures that several tests of rendering share."""

import pytest
from recorded_kernels import kernels_are_recorded_once, recordings  # noqa: F401


@pytest.fixture
def command(command):
    """The fixture of the same name, but it returns the errors; ``command.output`` is what else was written."""

    def run(line, *status):
        run.output, errors = command(line, *status)
        return errors

    return run


@pytest.fixture(scope="module")
def first_view():
    """Crops take the first view that shows anything. By default one of five is chosen, after dozens of attempts."""
    from data_gen.dataset import cameras

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "CHOICES", 1)
        yield


@pytest.fixture(scope="module")
def small_images_share():
    """Small images have a cache from the first sample on. It is small, since to read all its cells takes long."""
    from data_gen.tails import cache, schedule

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "CELLS", 1 << 17)
        patch.setattr(schedule, "BEGIN", 1)
        patch.setattr(schedule, "FIRST", 1 << 13)
        yield
