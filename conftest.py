"""Fixtures that several tests share."""

import os
import shlex
import signal

import numpy as np
import pytest
from browser import Browser, Session
from skips import allowed

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from ngpt.classical.gradients import forward_differences
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.methods import METHODS
from ngpt.stack import GradientStack

pytest_plugins = ["durations"]

# Other installed packages, such as ngpt-studies, add methods and samplers. Tests of all of them must know these, too.
for registry in (METHODS, SAMPLERS, FRAME_SAMPLERS):
    registry.load()


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


# A fixture -> the marker of all tests that stand on it.
MARKERS = {"renderer": "renders", "chromium": "browser", "toolchain": "hosts", "one_thread": "trains"}
MARKERS |= {"wheel": "processes"}
# A folder -> the marker of all tests in it.
FOLDERS = {"campaigns": "processes", "export": "exports", "evaluation": "evaluates"}
# Names that a test calls where it starts programs, or Node.
PROGRAMS = {"subprocess", "complete", "start", "shell", "in_a_child", "in_a_process", "imported_by", "run_python"}
PROGRAMS |= {"on_terminal", "read_exr_isolated"}
NAMES = {**dict.fromkeys(PROGRAMS, "processes"), "read_in_node": "hosts"}


def pytest_collection_modifyitems(items):
    """Marks tests by what they use; `quick` are those that use nothing that takes its time."""
    for item in items:
        found = {MARKERS[fixture] for fixture in MARKERS.keys() & set(item.fixturenames)}
        code = getattr(getattr(item, "function", None), "__code__", None)
        found |= {FOLDERS[folder] for folder in FOLDERS.keys() & set(item.path.parts)}
        found |= {NAMES[name] for name in NAMES.keys() & set(code.co_names if code else ())}
        if not found and not item.get_closest_marker("slow"):
            found.add("quick")
        for marker in sorted(found):
            item.add_marker(marker)
    # What is built goes first, so that it is built beside the rest where tests run in several processes.
    items.sort(key=lambda item: not item.get_closest_marker("hosts"))


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
def command(tmp_path, monkeypatch, capfd):
    """Calls a command line in the folder ``tmp_path``; returns what it wrote to standard output and error.

    The exit status must be 0, or one of the given ones.
    """
    monkeypatch.chdir(tmp_path)

    def call(line, *status):
        capfd.readouterr()
        try:
            found = main(shlex.split(line))
        except SystemExit as stop:  # of the parser
            found = stop.code or 0
        told = capfd.readouterr()
        assert found in (status or (0,)), (line, found, told.err)
        return told

    return call


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
def chromium(tmp_path_factory):
    """A headless browser; tests of pages skip where there is none."""
    started = Browser(tmp_path_factory.mktemp("chromium"))
    yield started
    started.close()


@pytest.fixture
def browser(chromium):
    """Opens a page at an address; in the end it is closed, and must have had nothing to complain of."""
    sessions = []

    def open_page(url):
        sessions.append(Session(chromium, url))
        return sessions[-1]

    yield open_page
    for session in sessions:
        session.close()
    assert [complaint for session in sessions for complaint in session.complaints] == []


@pytest.fixture(scope="session")
def toolchain():
    """Where ONNX Runtime's headers are: what compiles the C library skips where they, or CMake, are not to be had."""
    from capi import headers, tool

    tool("cmake")
    tool("g++", "clang++")
    return headers()


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
