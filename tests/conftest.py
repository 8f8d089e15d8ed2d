"""Fixtures that several tests share."""

import os
import signal

import numpy as np
import pytest
from skips import allowed

from ngpt.classical.gradients import forward_differences
from ngpt.errors import NgptError
from ngpt.stack import GradientStack


def strictly(report):
    """With ``NGPT_STRICT=1`` what is skipped for a reason that is not listed fails."""
    if os.environ.get("NGPT_STRICT") == "1" and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not allowed(reason):
            report.outcome, report.longrepr = "failed", f"{reason}: mend it, or list it in tests/skips.py"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return strictly((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return strictly((yield))


@pytest.fixture
def rng():
    return np.random.default_rng(20261121)


@pytest.fixture
def noisy_stack(rng):
    """A smooth image, 24x17, with noise of 0.1 on the primal and 0.01 on the gradients; and the image itself."""
    y, x = np.mgrid[0:17, 0:24] / 10
    clean = np.stack([1 + np.sin(x + c) * np.cos(y) for c in range(3)], axis=-1)
    clean[5:12, 8:15] += 1
    dx, dy = (g + rng.normal(0, 0.01, g.shape) for g in forward_differences(clean))
    stack = GradientStack.from_arrays(primal=clean + rng.normal(0, 0.1, clean.shape), dx=dx, dy=dy)
    return stack, clean


@pytest.fixture
def one_thread():
    """PyTorch on one thread: threads that wait for each other are slow where other processes want the cores as well."""
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def handlers_of_signals_stay():
    """One that is left behind would end other tests."""
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.fixture(scope="session")
def renderer():
    """Mitsuba with a CPU variant; tests that render skip where it, or LLVM, is not to be had."""
    pytest.importorskip("mitsuba")
    from data_gen.backend import use_variant

    try:
        use_variant("llvm_ad_rgb")
    except NgptError as error:
        pytest.skip(str(error))
    import mitsuba

    return mitsuba
