"""Commands killed at random moments: nothing half-written is seen, and what is run again ends as if undisturbed."""

import os
import shutil
import signal
import sys
import time

import numpy as np
import pytest
from processes import (
    RENDERS,
    ROOT,
    children,
    complete,
    ended,
    make_render,
    make_work,
    running,
    start,
    temporary_files,
    wait_for,
)
from reliability import record

from ngpt.system.files import exclusive


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


@pytest.mark.parametrize(("kind", "kills"), [("denoise", 4), pytest.param("train", 2, marks=pytest.mark.slow)])
def test_a_few_kills(tmp_path, kind, kills):
    kill_campaign(make_work(kind, tmp_path), tmp_path, kills)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", ["denoise", "data_gen", "train"])
def test_a_hundred_kills(tmp_path, kind):
    kill_campaign(make_work(kind, tmp_path), tmp_path, 100)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("what", RENDERS)
def test_kills_of_renders_of_several_passes(tmp_path, what):
    """The same command again leaves the bits of one that was left alone, and nothing else."""
    kill_campaign(make_render(what, tmp_path), tmp_path, 6)


WORKERS = """
import sys, time
from pathlib import Path
from data_gen.dataset.jobs import processes
from ngpt.system.console import run_command
from ngpt.system.files import exclusive

def run():
    with exclusive(sys.argv[1]), processes(2) as pool:
        tasks = [pool.submit(time.sleep, 600) for _ in range(2)]
        print("ready", flush=True)
        tasks[0].result()

if __name__ == "__main__":
    sys.exit(run_command(run))
"""


@pytest.fixture
def pool(tmp_path):
    """A process with two workers at work, and a folder that it keeps to itself."""
    pytest.importorskip("mitsuba")
    (tmp_path / "workers.py").write_text(WORKERS)
    process = start([sys.executable, tmp_path / "workers.py", tmp_path], stdout=-1)
    assert process.stdout.readline() == "ready\n"
    # Two workers, and Python's tracker of resources.
    assert wait_for(lambda: len(children(process.pid)) >= 3)
    yield process
    process.kill()
    process.wait()


def test_workers_end_with_a_killed_parent_and_its_lock_does_too(pool, tmp_path):
    workers = children(pool.pid)
    pool.kill()
    pool.wait()
    assert wait_for(lambda: not any(running(pid) for pid in workers), 20)
    with exclusive(tmp_path):
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_end_with_an_interrupted_parent_without_a_word(pool, number):
    workers = children(pool.pid)
    pool.send_signal(number)
    assert pool.wait(20) == 128 + number
    assert pool.stderr.read() == "ngpt: error: interrupted\n"
    assert wait_for(lambda: not any(running(pid) for pid in workers), 20)


@pytest.mark.slow
def test_workers_of_a_killed_generation_end(tmp_path):
    arguments = [*make_work("data_gen", tmp_path).arguments(tmp_path / "out"), "--workers", 2]
    process = start(arguments)
    assert wait_for(lambda: list(tmp_path.glob("out/shards/[!.]*")), 240)
    workers = children(process.pid)
    process.kill()
    process.wait()
    assert len(workers) >= 2 and wait_for(lambda: not any(running(pid) for pid in workers), 60)
    again = complete(arguments)
    assert again.returncode == 0, again.stderr
    assert temporary_files(tmp_path / "out") == []


def test_a_forked_process_does_not_hold_the_lock_of_a_dead_one(tmp_path):
    """As the workers of PyTorch's data loaders do, which notice the end of their parent some seconds late."""
    code = (
        "import os, sys, time; from ngpt.system.files import exclusive\n"
        "with exclusive(sys.argv[1]):\n"
        "    if os.fork() == 0: print('forked', os.getpid(), flush=True); time.sleep(60); os._exit(0)\n"
        "    time.sleep(60)"
    )
    process = start([sys.executable, "-c", code, tmp_path], stdout=-1, cwd=ROOT)
    child = int(process.stdout.readline().split()[1])
    process.kill()
    process.wait()
    try:
        assert running(child)
        with exclusive(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
