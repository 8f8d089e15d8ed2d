"""Ctrl-C (SIGINT) and SIGTERM, which service managers, containers and queues send: both end a command the same way."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from ngpt.errors import Interrupted

# Signals and their default handlers.
_SIGNALS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


class Interrupt:
    """The number of the first signal that has arrived, 0 before. Calling the object returns whether one has arrived."""

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

    A signal that other code handles or has switched off is left as it is. Outside of the main thread, both signals are
    left as they are.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = found.signal or number
        raise Interrupted

    # Python's own handlers show that no other code has set one. In background jobs of a script, SIGINT is ignored.
    ours = [number for number, usual in _SIGNALS.items() if signal.getsignal(number) is usual]
    with _handled(ours, note):
        yield found


@contextmanager
def noted(told: Callable[[], None] = lambda: None) -> Iterator[Interrupt]:
    """In the block, the first signal is only recorded; any further one has its previous effect.

    ``told`` is called as soon as the signal arrives. A signal that is switched off stays switched off. Outside of the
    main thread, no signal arrives.
    """
    found = Interrupt()

    def note(number, frame):
        found.signal = number
        for other, handler in before.items():
            signal.signal(other, handler)
        told()

    # None means a handler of a C program that embeds Python.
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
