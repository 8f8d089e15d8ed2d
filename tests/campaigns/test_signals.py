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

EARLY, DONE = "while Python starts and imports its own modules: as Python does", "done before"


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize(("kind", "interrupts"), [("denoise", 4), *(at_length(kind, 20) for kind in COMMANDS)])
def test_interrupts(tmp_path, kind, name, interrupts):
    """At moments spread over a whole run."""
    number = SIGNALS[name]
    interrupted = f"interrupted, status {128 + number}, one line"
    job, rng, clock = make_work(kind, tmp_path), np.random.default_rng(2), time.monotonic()
    assert complete(job.arguments(tmp_path / "out")).returncode == 0
    duration, outcomes = time.monotonic() - clock, {interrupted: 0, EARLY: 0, DONE: 0}
    for i in range(interrupts):
        out = tmp_path / f"out{i}"
        with start(job.arguments(out)) as process:
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


STREAMS = {
    "standard output read for one line": '"$@" | head -1',
    "both read for one line": '"$@" 2>&1 | head -1',
    "standard output closed": '"$@" >&-',
    "errors closed": '"$@" 2>&-',
    "all closed": '"$@" <&- >&- 2>&-',
    "standard output on a full disk": '"$@" > /dev/full',
    "both on a full disk": '"$@" > /dev/full 2>&1',
}


@pytest.mark.parametrize("kinds", [["merge"], at_length(list(COMMANDS))])
def test_output_that_nobody_takes(tmp_path, kinds):
    outcomes = {"work done": 0, "quiet or one line, nothing half-written": 0}
    for kind in kinds:
        folder = tmp_path / kind
        folder.mkdir()
        job = make_work(kind, folder)
        for i, (what, line) in enumerate(STREAMS.items()):
            out = folder / f"out{i}"
            run = shell(line, *job.arguments(out))
            assert "Traceback" not in run.stdout + run.stderr and "Exception ignored" not in run.stderr, (kind, what)
            assert run.returncode in (0, 1, 2, 141), (kind, what, run.stderr)
            assert half_written(out) == [] and temporary_files(out) == [], (kind, what)
            outcomes["quiet or one line, nothing half-written" if run.returncode else "work done"] += 1
    record("Output that nobody takes, seven ways for each command", sum(outcomes.values()), outcomes)
