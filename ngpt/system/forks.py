"""Threads and forks: what a process keeps for all its threads, and what a forked child must not inherit.

A forked child has the memory of its parent and none of its threads. A pool of threads that it inherits never answers,
and even to destroy it may take for ever. So what owns threads is dropped before a fork, and whoever needs it next, in
parent or child, makes its own.
"""

import os
from collections.abc import Callable
from functools import cache, lru_cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

Given = ParamSpec("Given")
Made = TypeVar("Made")


def hold_while_forking(lock: Lock, drop: Callable[[], object] = lambda: None) -> None:
    """No fork happens while another thread holds ``lock``; ``drop`` is called under it before each fork.

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
    """``call`` is called in every forked child from now on, in the thread that forked; once, however often it is given.

    For pools that cannot be dropped, such as OpenMP's: with one thread a child needs none of them.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=call)
