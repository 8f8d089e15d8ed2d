"""What the command line says while it works: a progress bar on a terminal, plain lines elsewhere.

Everything goes to standard error; standard output is kept for results (JSON, tables).
"""

import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from ngpt.errors import NgptError
from ngpt.system.limits import address_space

# Elsewhere than on a terminal, a line at most this often: a log should show life, not fill up.
SECONDS_BETWEEN_LINES = 5.0

# MiB of address space.
FEWEST_MIB = 512


def run_command(run: Callable[[], int], name: str = "ngpt", interrupted: str = "interrupted") -> int:
    """The exit status of a command: what ``run`` returns, or that of whatever stopped it, which is told in one line.

    2 for an error, 130 when interrupted, 1 when nobody reads standard output any more. ``interrupted`` says what an
    interrupt means for the work.
    """
    _open_standard_streams()
    console = Console(name=name)
    with _noted_interrupts() as pressed:
        try:
            _check_address_space()
            try:
                return run()
            finally:
                # Not when Python ends, which complains in its own way.
                sys.stdout.flush()
        except SystemExit:
            raise
        except BaseException as error:
            if isinstance(error, OSError):
                _close(sys.stdout)
            # Libraries that are interrupted, while they are imported above all, raise what they like.
            if pressed or isinstance(error, KeyboardInterrupt):
                console.error(interrupted)
                return 130
            if isinstance(error, BrokenPipeError):
                return 1
            console.error(_explanation(error))
            return 2


def _explanation(error: BaseException) -> str:
    """What to tell of an error that users can act on; raises it again if it is none."""
    match error:
        case NgptError() | OSError():
            return str(error)
        case MemoryError():
            return "out of memory; use a smaller image or fewer files at once"
        case ImportError():
            return f"a library cannot be loaded, for want of memory or since the installation is broken: {error}"
    raise error


@contextmanager
def _noted_interrupts() -> Iterator[list[int]]:
    """Yields a list that is empty until Ctrl-C is pressed."""
    pressed: list[int] = []

    def note(number, frame):
        pressed.append(number)
        raise KeyboardInterrupt

    # Neither where nobody is to hear it, in the background of a script, nor where signals do not arrive, in a thread.
    if (
        signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        or threading.current_thread() is not threading.main_thread()
    ):
        yield pressed
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _check_address_space() -> None:
    """Raises NgptError for a limit (``ulimit -v``) at which the libraries we load hang or abort, OpenBLAS first."""
    limit = address_space()
    if limit is not None and limit < FEWEST_MIB << 20:
        raise NgptError(
            f"the address space is limited to {limit >> 20} MiB (ulimit -v); {FEWEST_MIB} are the least that works"
        )


def print_line(text: str, stream: TextIO) -> None:
    """A message, at once. That nobody takes it, as when the disk with the log is full, stops no work."""
    try:
        print(text, file=stream, flush=True)
    except OSError:
        _close(stream)


def _close(stream: TextIO) -> None:
    """Sends what is still to come to nowhere, with what could not be written so far."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def _open_standard_streams() -> None:
    """A file opened while one of them is closed would take its place, and get what is printed."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    # Files may have letters in them that standard output has not: on Windows a pipe has those of one language.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


class Console:
    """Messages and progress for one command. ``quiet`` leaves only errors; ``name`` is what those begin with."""

    def __init__(self, quiet: bool = False, name: str = "ngpt"):
        self.quiet, self.name = quiet, name

    def say(self, text: str) -> None:
        if not self.quiet:
            print_line(text, sys.stderr)

    def error(self, text: object) -> None:
        print_line(f"{self.name}: error: {' '.join(str(text).split())}", sys.stderr)

    @contextmanager
    def progress(self, label: str, unit: str) -> Iterator[Callable[[int, int], None]]:
        """Yields ``update(done, total)``."""
        if self.quiet:
            yield lambda done, total: None
        elif sys.stderr.isatty():
            with _bar(label, unit) as update:
                yield update
        else:
            yield _Lines(self, label, unit)


@contextmanager
def _bar(label: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    # Imported only here: a pipeline without a terminal does not pay for it.
    from rich.console import Console as Terminal
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Terminal(stderr=True)) as progress:
        task = progress.add_task(label, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


class _Lines:
    """Progress as lines of text: the first, the last, and now and then one between."""

    def __init__(self, console: Console, label: str, unit: str):
        self.console, self.label, self.unit = console, label, unit
        self.start = self.last = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done in (0, total) or now - self.last >= SECONDS_BETWEEN_LINES:
            self.last = now
            elapsed = now - self.start
            times = f", {elapsed:.1f} s" if done else ""
            if 0 < done < total:
                times += f", about {elapsed * (total - done) / done:.0f} s left"
            self.console.say(f"{self.label}: {done}/{total} {self.unit}{times}")
