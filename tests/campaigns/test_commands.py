"""Commands killed or interrupted at random moments, and on full disks.

Nothing half-written is seen, one line or none is said, and what is run again ends as if undisturbed.
"""

import shutil
import signal
import subprocess
import time
from functools import cache

import numpy as np
import pytest
from processes import (
    COMMANDS,
    RENDERS,
    ROOT,
    SIGNALS,
    complete,
    ended,
    half_written,
    make_work,
    one_error,
    start,
    temporary_files,
)
from reliability import at_length, record


@pytest.mark.parametrize(
    ("kind", "kills"),
    [
        ("denoise", 2),
        *(at_length(kind, 100) for kind in ("denoise", "data_gen", "train")),
        *(at_length(kind, 6) for kind in RENDERS),
    ],
)
def test_kills(tmp_path, kind, kills):
    """Runs that continue each other are killed at moments spread over a whole run and, every other time, as they write.

    After ten kills, or when one is faster than its killer, what was made is compared, and the next starts from nothing.
    """
    job, rng, clock = make_work(kind, tmp_path), np.random.default_rng(1), time.monotonic()
    whole, out = tmp_path / "whole", tmp_path / "killed"
    undisturbed = complete(job.arguments(whole))
    assert undisturbed.returncode == 0, undisturbed.stderr
    expected, duration = job.results(whole), time.monotonic() - clock
    compared = done = most = since = 0  # since: kills after the last run that ended
    while done < kills or since:
        if done < kills and since < 10:
            target = out if done % 2 else None
            seconds = rng.uniform(0, 0.004) if target else rng.uniform(0, 0.6 * duration)
            status = ended(start(job.arguments(out)), seconds, writing=target)
        else:
            status = complete(job.arguments(out)).returncode
        assert status in (0, -signal.SIGKILL)
        seen = job.results(out)
        assert job.is_part(seen, expected)
        if status == 0:
            assert seen == expected, "a continued run ends like one that was left alone"
            assert temporary_files(out) == [], "the next run removes what killed ones left"
            compared, since = compared + 1, 0
            shutil.rmtree(out)
        else:
            done, since = done + 1, since + 1
            most = max(most, len(temporary_files(out)))
    record(
        f"SIGKILL at random moments of {job.name}",
        done,
        {"only whole files to be seen": done},
        worst={"temporary files left by one kill": most, "left after the next whole run": 0},
        compared=f"{compared} runs were continued to their end: bit for bit as one left alone",
        seconds=round(time.monotonic() - clock),
    )


EARLY, DONE = "while Python starts and imports its own modules: as Python does", "done before"


@pytest.mark.parametrize(
    ("kind", "name", "interrupts"),
    [at_length(kind, name, 20) for kind in COMMANDS for name in SIGNALS],
)
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


# In a mount namespace of its own, which ends with the process: no mount is ever seen by anyone else, or left.
MOUNTED = """
set -e
place=$1 options=$2 copy=$3
shift 3
mount -t tmpfs -o "$options" ngpt "$place"
case $copy in
read-only) mount -o remount,ro "$place"; exec "$@";;
*) set +e; "$@"; status=$?; cp -a "$place/." "$copy/"; exit $status;;
esac
"""


@cache
def unshare() -> tuple[str, ...]:
    """The command that starts another in such a namespace; skips the test where there is none."""
    for command in (("unshare", "--mount"), ("unshare", "--map-root-user", "--mount")):
        try:
            test = subprocess.run([*command, "mount", "-t", "tmpfs", "ngpt", "/mnt"], capture_output=True, timeout=30)
        except OSError:
            break
        if test.returncode == 0:
            return command
    pytest.skip("nothing can be mounted here: neither root nor user namespaces")


def on_a_disk(job, place, options: str, copy):
    """Runs a command with a disk mounted on ``place``; what is there in the end is copied, unless it is read-only."""
    arguments = job.arguments(place)
    return complete([*unshare(), "sh", "-c", MOUNTED, "sh", place, options, copy, *arguments])


@pytest.mark.parametrize(("kind", "disks"), [("denoise", 2), *(at_length(kind, 8) for kind in COMMANDS)])
def test_full_disks(tmp_path, kind, disks):
    job, clock = make_work(kind, tmp_path), time.monotonic()
    whole, place = tmp_path / "whole", tmp_path / "disk"
    place.mkdir()
    undisturbed = complete(job.arguments(whole))
    assert undisturbed.returncode == 0, undisturbed.stderr
    pages = sum(-(-path.stat().st_size // 4096) + 1 for path in whole.rglob("*") if path.is_file())
    outcomes = {"one line, nothing half-written": 0, "it was enough": 0}
    for i in range(disks):
        copy, kibibytes = tmp_path / f"left{i}", 4 * int(pages * (i + 0.5) / disks)
        copy.mkdir()
        # A disk of 0 KiB has a page, since none has less, but no room for a name beside its own.
        run = on_a_disk(job, place, f"size={kibibytes}k" if kibibytes else "size=4k,nr_inodes=1", copy)
        assert half_written(copy) == [] and temporary_files(copy) == [], (kibibytes, run.stderr)
        for kept in ROOT.glob("*.kept*"):  # what took long to make goes to the working directory
            assert str(kept) in run.stderr
            kept.unlink()
        if run.returncode:
            assert run.returncode in (1, 2) and one_error(run.stderr), (kibibytes, run.stderr)
            assert "No space left" in run.stderr or "cannot be written" in run.stderr, run.stderr
        outcomes["one line, nothing half-written" if run.returncode else "it was enough"] += 1
    assert outcomes["one line, nothing half-written"]
    record(f"Full disk under {job.name}", disks, outcomes, seconds=round(time.monotonic() - clock))


@pytest.mark.parametrize("kinds", [["denoise"], at_length(list(COMMANDS))])
def test_read_only_folders(tmp_path, kinds):
    for kind in kinds:
        place = tmp_path / kind / "place"
        place.mkdir(parents=True)
        run = on_a_disk(make_work(kind, tmp_path / kind), place, "size=64k", "read-only")
        assert run.returncode in (1, 2) and one_error(run.stderr), (kind, run.stderr)
        assert len(run.stderr.splitlines()) == 1, run.stderr
    record("Read-only folders, one for each command", len(kinds), {"one line": len(kinds)})
