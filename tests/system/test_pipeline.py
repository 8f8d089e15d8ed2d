"""Reading ahead and writing behind: the same results, in order, with few at once, however it ends."""

import threading
import time
from contextlib import closing

import pytest

from ngpt.errors import NgptError
from ngpt.system.pipeline import overlapped

ITEMS = list(range(7))


def same(value):
    return value


def stages(stage, work):
    """Reading, computing and writing, one of them with ``work`` to do."""
    return [work if k == stage else same for k in range(3)]


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_results_come_in_order(count):
    found = list(overlapped(ITEMS[:count], lambda i: i + 1, lambda i: 10 * i, lambda i: str(i)))
    assert found == [str(10 * (i + 1)) for i in range(count)]


def test_the_three_stages_run_at_once():
    """Each waits until all three have been inside at once: in turn, they would never meet."""
    meeting = threading.Barrier(3, timeout=30)

    def stage(first, last):
        # The first item to be computed meets the one being read behind it, and none being written.
        def work(i):
            if first <= i <= last:
                meeting.wait()
            return i

        return work

    assert list(overlapped(ITEMS, stage(2, 6), stage(1, 5), stage(0, 4))) == ITEMS


def test_at_most_three_are_held():
    lock, held, most = threading.Lock(), set(), []

    def read(i):
        with lock:
            held.add(i)
            most.append(len(held))
        return i

    def write(i):
        time.sleep(0.01)
        with lock:
            held.remove(i)
        return i

    assert list(overlapped(ITEMS, read, same, write)) == ITEMS
    assert max(most) <= 3


@pytest.mark.parametrize("error", [NgptError("three"), MemoryError()])
@pytest.mark.parametrize("stage", range(3))
def test_what_fails_is_told_in_its_turn_and_another_error_is_raised_after_what_came_before(stage, error):
    found, written = [], []

    def fail(i):
        if i == 3:
            raise error
        return i

    first, second, third = stages(stage, fail)

    def write(i):
        written.append(third(i))
        return i

    def run():
        for value in overlapped(ITEMS, first, second, write):
            found.append(value)

    if isinstance(error, NgptError):
        run()
        assert found == [0, 1, 2, error, 4, 5, 6]
    else:
        with pytest.raises(MemoryError):
            run()
        assert found == [0, 1, 2] and set(written) - {3} == {0, 1, 2}


@pytest.mark.parametrize("end", ["interrupt", "close"])
def test_an_early_end_finishes_what_is_being_written_and_starts_nothing(end):
    begun, written = [], []

    def compute(i):
        if i == 2 and end == "interrupt":
            raise KeyboardInterrupt
        return i

    def write(i):
        begun.append(i)
        time.sleep(0.1)
        written.append(i)
        return i

    before = threading.active_count()
    with closing(overlapped(ITEMS, same, compute, write)) as results:
        if end == "interrupt":
            with pytest.raises(KeyboardInterrupt):
                list(results)
        else:
            next(results)
    assert begun == written == [0, 1][: len(written)] and written
    assert threading.active_count() == before
