"""Commands killed at random moments: nothing half-written is seen, and what is run again ends as if undisturbed."""

import shutil
import signal
import time

import numpy as np
import pytest
from processes import (
    RENDERS,
    complete,
    ended,
    make_render,
    make_work,
    start,
    temporary_files,
)
from reliability import at_length, record


def kill_campaign(job, folder, kills):
    """Kills runs that continue each other, at moments spread over a whole run and, every other time, while they write.

    After ten kills, or when one is faster than its killer, what was made is compared, and the next starts from nothing.
    """
    rng, clock = np.random.default_rng(1), time.monotonic()
    whole = folder / "whole"
    undisturbed = complete(job.arguments(whole))
    assert undisturbed.returncode == 0, undisturbed.stderr
    expected, duration = job.results(whole), time.monotonic() - clock
    outcomes = {"only whole files to be seen": 0}
    compared = done = most = 0
    since = 0  # kills since the last run that ended
    out = folder / "killed"
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
            outcomes["only whole files to be seen"] += 1
            most = max(most, len(temporary_files(out)))
    return record(
        f"SIGKILL at random moments of {job.name}",
        done,
        outcomes,
        worst={"temporary files left by one kill": most, "left after the next whole run": 0},
        compared=f"{compared} runs were continued to their end: bit for bit as one left alone",
        seconds=round(time.monotonic() - clock),
    )


@pytest.mark.parametrize(
    ("kind", "kills"), [("denoise", 4), *(at_length(kind, 100) for kind in ("denoise", "data_gen", "train"))]
)
def test_kills(tmp_path, kind, kills):
    kill_campaign(make_work(kind, tmp_path), tmp_path, kills)


@pytest.mark.parametrize("what", map(at_length, RENDERS))
def test_kills_of_renders_of_several_passes(tmp_path, what):
    """The same command again leaves the bits of one that was left alone, and nothing else."""
    kill_campaign(make_render(what, tmp_path), tmp_path, 6)
