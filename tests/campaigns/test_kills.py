"""Commands killed at random moments: nothing half-written is seen, and what is run again ends as if undisturbed."""

import shutil
import signal
import time

import numpy as np
import pytest
from processes import RENDERS, complete, ended, make_work, start, temporary_files
from reliability import at_length, record


@pytest.mark.parametrize(
    ("kind", "kills"),
    [
        ("denoise", 4),
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
