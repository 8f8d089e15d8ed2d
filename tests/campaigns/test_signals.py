"""Ctrl-C and SIGTERM at random moments, and output that nobody takes: one line or none, and no traceback."""

import time

import numpy as np
import pytest
from processes import (
    COMMANDS,
    SIGNALS,
    complete,
    ended,
    half_written,
    make_work,
    one_error,
    shell,
    start,
    temporary_files,
)
from reliability import at_length, record

EARLY = "while Python starts and imports its own modules: as Python does"


DONE = "done before"


def interrupt_campaign(kind, folder, interrupts, name):
    """Ctrl-C or SIGTERM at moments spread over a whole run."""
    number = SIGNALS[name]
    interrupted = f"interrupted, status {128 + number}, one line"
    job, rng, clock = make_work(kind, folder), np.random.default_rng(2), time.monotonic()
    out = folder / "out"
    assert complete(job.arguments(out)).returncode == 0
    duration, outcomes = time.monotonic() - clock, {interrupted: 0, EARLY: 0, DONE: 0}
    for i in range(interrupts):
        out = folder / f"out{i}"
        arguments = job.arguments(out)
        with start(arguments) as process:
            status = ended(process, rng.uniform(0, duration), number)
            errors = process.stderr.read()
        assert half_written(out) == [] and temporary_files(out) == []
        if status == 128 + number:
            # train.py says on standard output that it stops, and keeps what it has learnt.
            assert one_error(errors) or (kind == "train" and ": error: " not in errors), errors
            outcomes[interrupted] += 1
        else:
            early = status == -number or "Fatal Python error: init" in errors
            assert (early or status == 0) and "in run_command" not in errors, (status, errors)
            assert ": error: " not in errors, (status, errors)
            outcomes[EARLY if status else DONE] += 1
    assert outcomes[interrupted]
    record(f"{name} at random moments of {job.name}", interrupts, outcomes, seconds=round(time.monotonic() - clock))


@pytest.mark.parametrize(
    ("kind", "name", "interrupts"),
    [
        *(("denoise", name, 4) for name in SIGNALS),
        *(at_length(kind, name, 20) for kind in COMMANDS for name in SIGNALS),
    ],
)
def test_interrupts(tmp_path, kind, name, interrupts):
    interrupt_campaign(kind, tmp_path, interrupts, name)


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


@pytest.mark.parametrize("kinds", [["merge"], at_length(list(COMMANDS))])
def test_output_that_nobody_takes(tmp_path, kinds):
    stream_campaign(kinds, tmp_path)
