"""Threads and forked children get what one thread gets, from every method and whatever else is kept in a process."""

import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from threading import get_ident

import numpy as np
import pytest
import scipy.fft
from full_stack import full_stack
from processes import complete, in_a_child, needs_forks, no_warning_of_forks

import ngpt
from ngpt.denoisers import oidn_filters
from ngpt.errors import NgptError
from ngpt.measure.metrics import METRICS, scores
from ngpt.methods import METHODS
from ngpt.network import run_onnx
from ngpt.network.shipped import WEIGHTS
from ngpt.system import limits
from ngpt.system.forks import until_fork
from ngpt.system.limits import processors
from ngpt.system.threads import map_parts

THREADS, ROUNDS = 4, 2
SIZES = [(24, 32), (24, 32), (32, 24), (24, 40)]
USABLE = [name for name, method in METHODS.items() if not method.missing()]


def stack(i):
    """Another image, of another exposure, for each thread."""
    return full_stack(*SIZES[i], seed=i).replace(motion=np.zeros((*SIZES[i], 2)))


def by_denoiser(i):
    held = stack(i)
    denoiser = ngpt.Denoiser(SIZES[i][::-1], albedo=True, normals=True, temporal=True)
    frame = held["primal"], held["albedo"], held["normal"]
    return np.stack([denoiser(*frame, flow=held["motion"]) for _ in range(2)])


def over_time(i):
    held, temporal = stack(i), ngpt.Temporal()
    return np.stack([temporal.next(held, scale * held["primal"]) for scale in (1.0, 1.1)])


def measured(i):
    held = stack(i)
    names = [name for name, metric in METRICS.items() if metric.missing is None or not metric.missing()]
    return np.array(list(scores(names, held["primal"], held["albedo"]).values()))


WORK = {name: lambda i, name=name: ngpt.denoise(stack(i), name) for name in USABLE}
WORK |= {"Denoiser": by_denoiser, "Temporal": over_time, "metrics": measured}
# These have all that other methods share: solvers, graphs, OIDN, and state between frames.
QUICK = ("l2", "wcv", "oidn", "ngpt-fast", "Denoiser", "Temporal", "metrics")


@needs_forks
@no_warning_of_forks
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WORK]
)
def test_threads_and_children_get_the_bits_of_one_thread(name):
    """A child that is forked after all this use works as its parent does, and the parent goes on after it."""
    work = WORK[name]
    expected = [work(i) for i in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as pool:
        for found in (list(pool.map(work, range(THREADS))) for _ in range(ROUNDS)):
            assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
    assert in_a_child(work) == expected[0].tobytes()
    assert np.array_equal(work(0), expected[0])


def test_callers_of_the_pool_in_many_threads_do_not_wait_for_each_other():
    results = []
    callers = [threading.Thread(target=lambda: results.append(map_parts(abs, range(50)))) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(20)
    assert results == 20 * [list(range(50))]
    with pytest.raises(ZeroDivisionError):
        map_parts(lambda n: 1 // n, [1, 0, 1])


def test_readers_in_threads_leave_stdout_and_stderr_to_the_program(tmp_path):
    for i in range(4):
        ngpt.write(tmp_path / f"{i}.exr", stack(i))
    before = sys.stdout, os.fstat(2).st_ino
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: ngpt.read(tmp_path / f"{i % 4}.exr"), range(100)))
    assert (sys.stdout, os.fstat(2).st_ino) == before


def test_writers_in_threads_leave_the_mask_of_new_files_as_it_is(tmp_path, monkeypatch):
    real, before = os.umask, os.umask(0o027)
    monkeypatch.setattr(os, "umask", lambda mask: (real(mask), time.sleep(0.05))[0])
    try:
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda i: ngpt.write(tmp_path / f"{i}.exr", stack(0)), range(8)))
    finally:
        after = real(before)
    assert after == 0o027
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o640}


@needs_forks
@no_warning_of_forks
@pytest.mark.parametrize("name", [name for name in ("oidn", "ngpt-fast") if name in USABLE])
def test_a_child_ends_by_itself(name):
    """By ``sys.exit`` too, where all that is left is destroyed."""
    code = f"""
import os, sys
sys.path.insert(0, "tests")
import ngpt
from full_stack import full_stack
held = ngpt.Temporal(), full_stack(24, 32)
ngpt.denoise(held[1], {name!r})
if os.fork() == 0:
    ngpt.denoise(held[1], {name!r})
    sys.exit(7)
print(os.waitstatus_to_exitcode(os.wait()[1]))
"""
    result = complete([sys.executable, "-c", code], timeout=60)
    assert result.stdout == "7\n" and result.stderr == ""


@needs_forks
@no_warning_of_forks
def test_a_fork_while_other_threads_work_leaves_a_child_that_works(tmp_path):
    ngpt.write(tmp_path / "s.exr", stack(0))

    def read_and_denoise(_):
        return ngpt.denoise(ngpt.read(tmp_path / "s.exr"), "auto")

    expected = read_and_denoise(0)
    with ThreadPoolExecutor(2) as pool:
        busy = [pool.submit(read_and_denoise, 0) for _ in range(6)]
        assert in_a_child(read_and_denoise) == expected.tobytes()
        assert all(np.array_equal(each.result(), expected) for each in busy)


@needs_forks
@no_warning_of_forks
def test_what_owns_threads_is_made_anew_in_parent_and_child():
    made = until_fork(2)(lambda key: np.array([os.getpid(), key, *map_parts(abs, [-1])]))
    first = made(1)
    assert made(1) is first
    child = np.frombuffer(in_a_child(made, 1), first.dtype)
    assert child[0] != os.getpid() and child[1:].tolist() == [1, 1]
    assert made(1) is not first


@pytest.fixture
def limit():
    """``limit_threads``, without a limit after the test."""
    yield ngpt.limit_threads
    limits._most = None


def test_a_limit_of_threads_holds_for_everything_that_has_some(limit, monkeypatch):
    limit(1)
    assert len({get_ident() for _ in range(9)} | set(map_parts(lambda _: get_ident(), range(64)))) == 2
    assert run_onnx.Network(WEIGHTS / "ngpt-fast.onnx").session.get_session_options().intra_op_num_threads == 1
    workers, real = [], scipy.fft.dctn

    def noted(*args, **given):
        workers.append(given["workers"])
        return real(*args, **given)

    monkeypatch.setattr(scipy.fft, "dctn", noted)
    ngpt.denoise(stack(0), "l2")
    assert workers and set(workers) == {1}
    limit(processors() + 5)
    assert processors() == len(os.sched_getaffinity(0)), "a limit asks for no more than there is"
    for bad in (0, -1, 1.5, True):
        with pytest.raises(NgptError, match=r"threads: .* is not allowed; give a whole number, 1 or more"):
            limit(bad)


@pytest.mark.skipif(METHODS["oidn"].missing() != "", reason="OIDN is not installed")
def test_a_limit_of_threads_holds_for_oidn(limit):
    free = ngpt.denoise(stack(0), "oidn")
    limit(1)
    assert np.allclose(ngpt.denoise(stack(0), "oidn"), free, rtol=1e-5, atol=1e-6)
    device = oidn_filters._devices["auto", 1]
    assert device.type.name != "CPU" or device.num_threads == 1
