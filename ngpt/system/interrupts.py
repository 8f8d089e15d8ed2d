"""Ctrl-C (SIGINT) and SIGTERM, which service managers, containers and queues send: both end a command alike."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from ngpt.errors import Interrupted

# Signals, and the handlers that are there where nobody has set another.
_SIGNALS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


class Interrupt:
    """Which signal came first, 0 while none has; called, it says whether one has."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self) -> bool:
        return self.signal != 0

    @property
    def status(self) -> int:
        """What a command that was interrupted ends with, as a shell has it: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def raised() -> Iterator[Interrupt]:
    """Both signals raise ``Interrupted`` in the block, so that everything is cleaned up, and are noted.

    A signal that other code handles or has switched off is not touched. Outside of the main thread neither is.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = found.signal or number
        raise Interrupted

    # Python's own handlers show that no other code has set one. The background jobs of a script have other handlers.
    ours = [number for number, usual in _SIGNALS.items() if signal.getsignal(number) is usual]
    with _handled(ours, note):
        yield found


@contextmanager
def noted(told: Callable[[], None] = lambda: None) -> Iterator[Interrupt]:
    """The first signal is noted in the block, and nothing else; any further one does what it did before.

    ``told`` is called as soon as the signal arrives. A signal that is switched off stays so, and outside of the main
    thread none arrives.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = number
        for other, handler in before.items():
            signal.signal(other, handler)
        told()

    # None: a handler of a C program that embeds Python.
    before = {number: old for number in _SIGNALS if (old := signal.getsignal(number)) not in (signal.SIG_IGN, None)}
    with _handled(list(before), note):
        yield found


@contextmanager
def _handled(numbers: Sequence[int], handler: Callable) -> Iterator[None]:
    """Handles these signals in the block, then restores the handlers. Only in the main thread, where signals arrive."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
