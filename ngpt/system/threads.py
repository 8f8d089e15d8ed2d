"""One pool of threads for NumPy: it releases Python's lock while it works, so that parts of an array go in parallel."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ngpt.system.forks import until_fork


def map_parts(function: Callable[[Any], Any], parts: Iterable) -> list:
    """What ``function(part)`` returns for each of ``parts``, in their order, computed on all cores.

    ``function`` must not call this in its turn: threads that wait for threads of the same pool may wait for ever.
    """
    return list(_threads().map(function, parts))


@until_fork(1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="ngpt")
