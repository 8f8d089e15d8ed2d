"""Reading ahead and writing behind: the same results, in order, with few at once, however it ends."""

import threading
import time
from contextlib import closing, suppress

import pytest

from ngpt.errors import NgptError
from ngpt.system.pipeline import overlapped

ITEMS = list(range(7))


def same(value):
    return value


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


@pytest.mark.parametrize("stage", range(3))
def test_an_error_of_ngpt_takes_the_place_of_a_result_and_any_other_ends_the_work(stage):
    for error in (NgptError("three"), MemoryError()):

        def fail(i, error=error):
            if i == 3:
                raise error
            return i

        results, found = overlapped(ITEMS, *(fail if k == stage else same for k in range(3))), []
        with suppress(MemoryError):
            for value in results:
                found.append(value)
        assert found == [0, 1, 2] + ([error, 4, 5, 6] if isinstance(error, NgptError) else [])


def test_few_are_held_and_an_early_end_finishes_what_is_being_written_and_starts_nothing():
    read, begun, written, before = [], [], [], threading.active_count()

    def write(i):
        begun.append(i)
        time.sleep(0.05)
        written.append(i)
        return i

    with closing(overlapped(ITEMS, lambda i: read.append(i) or i, same, write)) as results:
        assert [next(results), next(results)] == [0, 1]
        assert len(read) <= 5, "two results, and three on the way"
    assert begun == written == ITEMS[: len(written)] and threading.active_count() == before
