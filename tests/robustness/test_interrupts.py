"""Ctrl-C, and output that nobody takes: one line or none, a status that says so, and no traceback."""

import fcntl
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from processes import (
    COMMANDS,
    ROOT,
    complete,
    ended,
    half_written,
    make_work,
    one_error,
    start,
    temporary_files,
    timeless,
)
from reliability import record

INTERRUPTED = "interrupted, status 130, one line"
EARLY = "while Python starts and imports its own modules: its traceback"
DONE = "done before"


def interrupt_campaign(kind, folder, interrupts):
    """Ctrl-C at moments spread over a whole run."""
    job, rng, clock = make_work(kind, folder), np.random.default_rng(2), time.monotonic()
    out = folder / "out"
    assert complete(job.arguments(out)).returncode == 0
    duration, outcomes = time.monotonic() - clock, {INTERRUPTED: 0, EARLY: 0, DONE: 0}
    for i in range(interrupts):
        out = folder / f"out{i}"
        arguments = job.arguments(out)
        with start(arguments) as process:
            status = ended(process, rng.uniform(0, duration), signal.SIGINT)
            errors = process.stderr.read()
        assert half_written(out) == [] and temporary_files(out) == []
        # Python sends itself the signal where it was inside of `exec`, which is 130 for a shell, too.
        if status == 130 or (status == -signal.SIGINT and one_error(errors)):
            # train.py says on standard output that it stops, and keeps what it has learnt.
            assert one_error(errors) or (kind == "train" and ": error: " not in errors), errors
            outcomes[INTERRUPTED] += 1
        else:
            early = status == -signal.SIGINT or "Fatal Python error: init" in errors
            assert (early or status == 0) and "in run_command" not in errors, (status, errors)
            outcomes[EARLY if status else DONE] += 1
    assert outcomes[INTERRUPTED]
    record(f"Ctrl-C at random moments of {job.name}", interrupts, outcomes, seconds=round(time.monotonic() - clock))


@pytest.mark.parametrize("kind", ["denoise", "export"])
def test_a_few_interrupts(tmp_path, kind):
    interrupt_campaign(kind, tmp_path, 4)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", COMMANDS)
def test_many_interrupts(tmp_path, kind):
    interrupt_campaign(kind, tmp_path, 20)


def shell(line, *arguments):
    """Runs a line of shell in which "$@" is a command."""
    return complete(["bash", "-c", f"set -o pipefail; {line}", "bash", *arguments])


NGPT = (sys.executable, "-m", "ngpt")


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A small stack's file."""
    folder = tmp_path_factory.mktemp("stack")
    make_work("denoise", folder)
    return folder / "inputs" / "0.exr"


@pytest.mark.parametrize(
    "arguments", [["info", "--aliases"], ["info", "{stack}", "--json"], ["--help"], ["advise", "-h"]]
)
def test_a_reader_that_has_enough(arguments, stack):
    run = shell('"$@" | head -c 1', *NGPT, *(a.format(stack=stack) for a in arguments))
    assert run.stderr == "" and run.returncode in (0, 1, 141)


def closed_streams(job, folder):
    """Each way in which nobody takes what a command prints; yields (what it is, the run, where it wrote)."""
    lines = {
        "standard output read for one line": '"$@" | head -1',
        "both read for one line": '"$@" 2>&1 | head -1',
        "standard output closed": '"$@" >&-',
        "errors closed": '"$@" 2>&-',
        "all closed": '"$@" <&- >&- 2>&-',
        "standard output on a full disk": '"$@" > /dev/full',
        "both on a full disk": '"$@" > /dev/full 2>&1',
    }
    for i, (what, line) in enumerate(lines.items()):
        out = folder / f"out{i}"
        yield what, shell(line, *job.arguments(out)), out


def stream_campaign(kinds, folder):
    outcomes = {"work done": 0, "quiet or one line, nothing half-written": 0}
    for kind in kinds:
        (folder / kind).mkdir()
        for what, run, out in closed_streams(make_work(kind, folder / kind), folder / kind):
            assert "Traceback" not in run.stdout + run.stderr and "Exception ignored" not in run.stderr, (kind, what)
            assert run.returncode in (0, 1, 2, 141), (kind, what, run.stderr)
            assert half_written(out) == [] and temporary_files(out) == [], (kind, what)
            outcomes["work done" if run.returncode == 0 else "quiet or one line, nothing half-written"] += 1
    record("Output that nobody takes, seven ways for each command", sum(outcomes.values()), outcomes)


def test_output_that_nobody_takes(tmp_path):
    stream_campaign(["merge"], tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_output_of_all_commands_that_nobody_takes(tmp_path):
    stream_campaign(COMMANDS, tmp_path)


def test_files_do_not_take_the_place_of_a_closed_stream(tmp_path, stack):
    """Else what is printed would go into the next file opened."""
    out = tmp_path / "o.exr"
    run = shell('"$@" >&- 2>&-', *NGPT, "denoise", stack, "-o", out, "-m", "l2", "--json")
    assert run.returncode == 0 and half_written(tmp_path) == []
    assert complete([*NGPT, "denoise", stack, "-o", tmp_path / "p.exr", "-m", "l2"]).returncode == 0
    assert timeless(out) == timeless(tmp_path / "p.exr")


def test_results_that_cannot_be_printed_are_an_error(stack):
    run = shell('"$@" > /dev/full', *NGPT, "info", stack, "--json")
    assert run.returncode == 2 and one_error(run.stderr) and "No space left" in run.stderr


def test_a_reader_that_takes_its_time_gets_everything(stack):
    """More than a pipe holds, to a reader that sleeps first."""
    whole = complete([*NGPT, "info", "--aliases"]).stdout
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    assert len(whole) > 0
    with start([*NGPT, "info", "--aliases"], stdout=writer) as process:
        os.close(writer)
        time.sleep(1)
        with os.fdopen(reader) as file:
            assert file.read() == whole
        assert process.wait(60) == 0


def test_an_interrupt_during_import_is_one_line():
    """The slowest part of a short command, and outside of what a command can see of itself."""
    code = (
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'numpy': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from ngpt.cli import main\n"
        "sys.exit(main(['info', '--aliases']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (run.returncode, run.stderr) == (130, "ngpt: error: interrupted\n")
