"""Workers of a pool end with their parent, however it ends; a lock ends with the process that holds it."""

import os
import signal
import sys

import pytest
from processes import children, complete, running, start, wait_for

from ngpt.system.files import exclusive

WORKERS = """
import signal, sys, threading, time
from data_gen.dataset.jobs import processes
from ngpt.system.console import run_command
from ngpt.system.files import exclusive

def run():
    with exclusive(sys.argv[1]), processes(2) as pool:
        tasks = [pool.submit(time.sleep, 600) for _ in range(2)]
        if "locked" in sys.argv:
            tasks[0]._condition = InterruptedOnceLocked()
        print("ready", flush=True)
        tasks[0].result()

class InterruptedOnceLocked(threading.Condition):
    def __enter__(self):
        super().__enter__()
        if threading.current_thread() is threading.main_thread():
            signal.raise_signal(signal.SIGINT)

if __name__ == "__main__":
    sys.exit(run_command(run))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_workers_end_with_their_parent_and_its_lock_does_too(tmp_path, number):
    pytest.importorskip("mitsuba")
    (tmp_path / "workers.py").write_text(WORKERS)
    with start([sys.executable, tmp_path / "workers.py", tmp_path], stdout=-1) as pool:
        assert pool.stdout.readline() == "ready\n"
        # Two workers, and Python's tracker of resources.
        assert wait_for(lambda: len(children(pool.pid)) >= 3)
        workers = children(pool.pid)
        pool.send_signal(number)
        interrupted = number != signal.SIGKILL
        assert pool.wait(20) == (128 + number if interrupted else -number)
        assert wait_for(lambda: not any(running(pid) for pid in workers), 20)
        assert not interrupted or pool.stderr.read() == "ngpt: error: interrupted\n"
    with exclusive(tmp_path):
        pass


def test_an_interrupt_never_leaves_a_lock_of_the_pool_held(tmp_path):
    """Its own thread would wait for the lock, and the command would hang."""
    pytest.importorskip("mitsuba")
    (tmp_path / "workers.py").write_text(WORKERS)
    run = complete([sys.executable, tmp_path / "workers.py", tmp_path, "locked"], timeout=60)
    assert (run.returncode, run.stderr) == (130, "ngpt: error: interrupted\n")


def test_a_forked_process_does_not_hold_the_lock_of_a_dead_one(tmp_path):
    """As the workers of PyTorch's data loaders do, which notice the end of their parent some seconds late."""
    code = (
        "import os, sys, time; from ngpt.system.files import exclusive\n"
        "with exclusive(sys.argv[1]):\n"
        "    if os.fork() == 0: print('forked', os.getpid(), flush=True); time.sleep(60); os._exit(0)\n"
        "    time.sleep(60)"
    )
    process = start([sys.executable, "-c", code, tmp_path], stdout=-1)
    child = int(process.stdout.readline().split()[1])
    process.kill()
    process.wait()
    try:
        assert running(child)
        with exclusive(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
