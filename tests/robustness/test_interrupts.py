"""Ctrl-C, SIGTERM, and output that nobody takes: one line or none, a status that says so, and no traceback."""

import os
import signal
import sys

import pytest
from processes import NGPT, SIGNALS, complete, content, half_written, make_work, one_error, shell, start

import ngpt
from ngpt.cli import main
from ngpt.system.console import print_line, run_command


def test_sigterm_leaves_the_samples_done_so_far(tmp_path):
    """As a queue ends a job that has used up its time."""
    pytest.importorskip("mitsuba")
    out = tmp_path / "s.exr"
    words = ["diffuse", "--size", "48x32", "--sampler", "primal", "--spp", 2_000_000_000, "-o", out]
    with start([*NGPT, "render", *words]) as process:
        assert ": 0/" in process.stderr.readline()  # progress, as the first pass begins
        process.terminate()
        errors = process.stderr.read()
        assert process.wait(60) == 143, errors
    spp = ngpt.read(out).attributes["ngpt:spp"]
    assert spp > 0 and one_error(errors) and f"interrupted: {out} holds the {spp} samples per pixel" in errors
    assert os.listdir(tmp_path) == ["s.exr"]


@pytest.mark.parametrize("name", SIGNALS)
def test_an_interrupt_has_its_status_wherever_it_comes(name, tmp_path):
    """Python 3.11 ends itself by SIGINT after a KeyboardInterrupt in code that was compiled from a text."""
    (tmp_path / "texts.py").write_text(
        "import os, sys\nfrom ngpt.system.console import run_command\n"
        f"sys.exit(run_command(lambda: exec('os.kill(os.getpid(), {int(SIGNALS[name])}); [0 for i in range(9)]')))"
    )
    run = complete([sys.executable, "-m", "texts"], cwd=tmp_path)
    assert (run.returncode, run.stderr) == (128 + SIGNALS[name], "ngpt: error: interrupted\n")


@pytest.mark.parametrize("module", ["argparse", "numpy"])
def test_an_interrupt_during_import_is_one_line(module):
    """The slowest part of a short command; argparse comes before the command is there."""
    code = (
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, *rest):\n"
        f"        if name == {module!r}: raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from ngpt.__main__ import main\n"
        "sys.argv[1:] = ['info', '--aliases']\n"
        "sys.exit(main())"
    )
    run = complete([sys.executable, "-c", code])
    assert (run.returncode, run.stderr) == (130, "ngpt: error: interrupted\n")


def test_a_second_sigterm_discards_them():
    from data_gen.session import stop_on_ctrl_c

    def run():
        with stop_on_ctrl_c() as stop:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop() and stop.status == 143
            os.kill(os.getpid(), signal.SIGTERM)
        return 0

    # A fixture of conftest checks that the handlers are the ones from before.
    assert run_command(run) == 143


def test_handlers_of_others_stay(capfd):
    """A host that has one of its own for SIGTERM, and runs a command within itself."""
    got = []
    before = signal.signal(signal.SIGTERM, lambda *_: got.append(1))
    try:
        assert run_command(lambda: os.kill(os.getpid(), signal.SIGTERM) or 0) == 0 and got == [1]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_handler_prints_amid_a_line(tmp_path):
    """Where a signal comes while a line is printed, its handler cannot enter the same buffer: it ended the render."""

    class Entered:
        encoding = "utf-8"

        def __init__(self, file):
            self.fileno = file.fileno

        def write(self, text):
            raise RuntimeError("reentrant call inside <_io.BufferedWriter name=3>")

    with open(tmp_path / "log", "wb") as file:
        print_line("interrupted", Entered(file))
    assert (tmp_path / "log").read_text() == "interrupted\n"


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A small stack's file."""
    folder = tmp_path_factory.mktemp("stack")
    make_work("denoise", folder)
    return folder / "inputs" / "0.exr"


@pytest.mark.parametrize("arguments", [["info", "--aliases"], ["info", "{stack}", "--json"], ["advise", "-h"]])
def test_a_reader_that_has_enough(arguments, stack):
    run = shell('"$@" | head -c 1', *NGPT, *(a.format(stack=stack) for a in arguments))
    assert run.stderr == "" and run.returncode in (0, 1, 141)


def test_files_do_not_take_the_place_of_a_closed_stream(tmp_path, stack):
    """Otherwise what is printed would go into the next file that is opened."""
    out = tmp_path / "o.exr"
    run = shell('"$@" >&- 2>&-', *NGPT, "denoise", stack, "-o", out, "-m", "l2", "--json")
    assert run.returncode == 0 and half_written(tmp_path) == []
    assert main(["denoise", str(stack), "-o", str(tmp_path / "p.exr"), "-m", "l2"]) == 0
    assert content(out) == content(tmp_path / "p.exr")


def test_results_that_cannot_be_printed_are_an_error(stack):
    run = shell('"$@" > /dev/full', *NGPT, "info", stack, "--json")
    assert run.returncode == 1 and one_error(run.stderr) and "No space left" in run.stderr
    assert shell('"$@" > /dev/full 2>&1', *NGPT, "info", stack, "--json").returncode == 1
