"""A pool of threads that computes parts of arrays in parallel, because NumPy releases Python's lock."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ngpt.system.forks import until_fork
from ngpt.system.limits import processors


def map_parts(function: Callable[[Any], Any], parts: Iterable) -> list:
    """``function(part)`` for each of ``parts``, in their order, computed by ``processors()`` threads.

    ``function`` must not call ``map_parts``: threads that wait for threads of the same pool may wait forever.
    """
    return list(_threads(processors()).map(function, parts))


@until_fork(2)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="ngpt")
