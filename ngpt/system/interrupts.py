"""Handles Ctrl-C (SIGINT) and SIGTERM in the same way. Service managers, containers and queues send SIGTERM."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from ngpt.errors import Interrupted

# Signals and their default handlers
_SIGNALS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


class Interrupt:
    """Records the number of the first signal; 0 if none has arrived. A call returns whether a signal has arrived."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self) -> bool:
        return self.signal != 0

    @property
    def status(self) -> int:
        """The exit status of an interrupted command, by the shell's convention: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def raised() -> Iterator[Interrupt]:
    """In the block, both signals are recorded and raise ``Interrupted``, so that everything is cleaned up.

    Signals that other code handles or ignores are not changed. Outside of the main thread, nothing is changed.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = found.signal or number
        raise Interrupted

    # A handler that is not Python's default was set by other code. In background jobs of a script, SIGINT is ignored.
    free = [number for number, usual in _SIGNALS.items() if signal.getsignal(number) is usual]
    with _handled(free, note):
        yield found


@contextmanager
def noted(notify: Callable[[], None] = lambda: None) -> Iterator[Interrupt]:
    """In the block, the first signal is only recorded, and ``notify`` is called. A second signal acts as usual.

    Ignored signals stay ignored. Outside of the main thread, nothing is changed.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = number
        for other, handler in before.items():
            signal.signal(other, handler)
        notify()

    # None is the handler of a C program that embeds Python.
    before = {number: old for number in _SIGNALS if (old := signal.getsignal(number)) not in (signal.SIG_IGN, None)}
    with _handled(list(before), note):
        yield found


@contextmanager
def _handled(numbers: Sequence[int], handler: Callable) -> Iterator[None]:
    """Sets a handler for these signals in the block. Does nothing outside of the main thread, where none arrives."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
