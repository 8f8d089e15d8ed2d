"""Workers of a pool end with their parent, however it ends; a lock ends with the process that holds it."""

import os
import signal
import sys

import pytest
from processes import (
    ROOT,
    children,
    running,
    start,
    wait_for,
)

from ngpt.system.files import exclusive

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
