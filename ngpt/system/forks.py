"""Objects that own threads, such as pools, in processes that fork.

A forked child has the memory of its parent but none of its threads. An inherited pool of threads never answers, and
even destroying it may hang. So objects that own threads are dropped before a fork; parent and child make new ones when
they need them.
"""

import os
from collections.abc import Callable
from functools import cache, lru_cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

Given = ParamSpec("Given")
Made = TypeVar("Made")


def hold_while_forking(lock: Lock, drop: Callable[[], object] = lambda: None) -> None:
    """From now on, no fork happens while another thread holds ``lock``. Before each fork, ``drop`` is called with the
    lock held.

    The thread that forks must not hold the lock itself.
    """

    def before() -> None:
        lock.acquire()
        drop()

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=before, after_in_parent=lock.release, after_in_child=lock.release)


def until_fork(most: int) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """A decorator: keeps the ``most`` last results, as ``lru_cache`` does, for results that own threads.

    Threads that ask for the same result at the same time get the same object. Before a fork all results are dropped.
    """

    def decorate(make: Callable[Given, Made]) -> Callable[Given, Made]:
        lock = Lock()
        cached: Any = lru_cache(most)(make)

        @wraps(make)
        def kept(*args: Given.args, **kwargs: Given.kwargs) -> Made:
            with lock:
                return cached(*args, **kwargs)

        hold_while_forking(lock, cached.cache_clear)
        return kept

    return decorate


@cache
def in_children(call: Callable[[], object]) -> None:
    """From now on ``call`` runs in every forked child, in the thread that forked; once, even if registered repeatedly.

    It is for pools that cannot be dropped, such as OpenMP's: a child that is set to one thread does not use the pool.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=call)
