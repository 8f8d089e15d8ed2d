"""Drops objects that own threads, such as pools, before a process forks.

A forked child has the memory of its parent but none of its threads. An inherited pool of threads never answers, and
its destruction may hang. Parent and child make new objects when they need them.
"""

import os
from collections.abc import Callable
from functools import cache, lru_cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

Given = ParamSpec("Given")
Made = TypeVar("Made")


def hold_while_forking(lock: Lock, drop: Callable[[], object] = lambda: None) -> None:
    """Makes each fork wait until no other thread holds ``lock``. Before the fork, calls ``drop`` with the lock held.

    The thread that forks must not hold the lock.
    """

    def before() -> None:
        lock.acquire()
        drop()

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=before, after_in_parent=lock.release, after_in_child=lock.release)


def until_fork(most: int) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """A decorator like ``lru_cache(most)``, for functions whose results own threads.

    Two threads that need the same result at once get the same object. Before a fork, all results are dropped.
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
    """Makes each forked child run ``call`` once, in the thread that forked.

    It is for pools that cannot be dropped, such as OpenMP's: a child that is set to one thread does not use its pool.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=call)
