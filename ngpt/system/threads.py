"""One pool of threads for NumPy: it releases Python's lock while it works, so that parts of an array go in parallel."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any


def map_parts(function: Callable[[Any], Any], parts: Iterable) -> list:
    """What ``function(part)`` returns for each of ``parts``, in their order, computed on all cores.

    ``function`` must not call this in its turn: threads that wait for threads of the same pool may wait for ever.
    """
    return list(_threads().map(function, parts))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="ngpt")


if hasattr(os, "register_at_fork"):
    # The threads of the parent are none of a forked child's, which would wait for them for ever.
    os.register_at_fork(after_in_child=_threads.cache_clear)
