"""The pool of threads: order, errors, and that it is there after a fork."""

import multiprocessing
import threading

import pytest

from ngpt.system.threads import map_parts


def test_results_come_in_the_order_of_the_parts():
    assert map_parts(lambda n: n * n, range(100)) == [n * n for n in range(100)]


def test_an_error_of_a_part_is_the_caller_s():
    with pytest.raises(ZeroDivisionError):
        map_parts(lambda n: 1 // n, [1, 0, 1])


def test_callers_in_many_threads_do_not_wait_for_each_other():
    results = []
    callers = [threading.Thread(target=lambda: results.append(map_parts(abs, range(50)))) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(20)
    assert results == 20 * [list(range(50))]


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_it_works_in_a_forked_child():
    map_parts(abs, range(10))
    child = multiprocessing.get_context("fork").Process(target=map_parts, args=(abs, range(10)))
    child.start()
    child.join(20)
    alive = child.is_alive()
    child.kill()
    assert not alive and child.exitcode == 0
