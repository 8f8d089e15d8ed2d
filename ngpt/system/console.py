"""Output of the command line while it works: a progress bar on a terminal, plain lines elsewhere.

Everything goes to standard error; standard output is kept for results (JSON, tables).
"""

import io
import logging
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from ngpt.errors import NgptError, WrongUse
from ngpt.system.interrupts import raised
from ngpt.system.limits import address_space
from ngpt.system.text import printable

# Without a terminal, the time between two lines of progress is at least this number of seconds, and at least 1 / LINES
# of the elapsed time, so that logs stay short.
SECONDS_BETWEEN_LINES = 5.0
LINES = 50

# The columns of a terminal that a bar takes beside its label: WIDE in the wide form, RATE more if it shows a rate, and
# NARROW in the narrow form, which has only numbers and the time left. The narrow form is used if fewer than LABEL
# columns remain for the label.
WIDE, RATE, NARROW, LABEL = 58, 14, 22, 12

# The least address space that ngpt needs, in MiB
FEWEST_MIB = 512


def run_command(run: Callable[[], int], name: str = "ngpt", interrupted: str = "interrupted") -> int:
    """Runs a command and returns its exit status, which ``run`` returns.

    After an error, prints a line and returns 1, or 2 for ``WrongUse``. After an interrupt, prints the message
    ``interrupted`` and returns 130 (Ctrl-C) or 143 (SIGTERM). If standard output has no reader any more, returns 1.
    """
    _open_standard_streams()
    console = Console(name=name)
    with _own_stderr(), raised() as interrupt:
        try:
            _check_address_space()
            try:
                return run()
            finally:
                # The output is flushed here, because Python would report an error at its exit in its own way.
                sys.stdout.flush()
        except SystemExit:
            raise
        except BaseException as error:
            if isinstance(error, OSError):
                _close(sys.stdout)
            # A library that is interrupted may raise any exception, mainly while it is imported.
            if interrupt() or isinstance(error, KeyboardInterrupt):
                console.error(interrupted)
                return interrupt.status
            if isinstance(error, BrokenPipeError):
                return 1
            console.error(_explanation(error))
            return 2 if isinstance(error, WrongUse) else 1


def _explanation(error: BaseException) -> str:
    """The message of an error that users can act on. Raises any other error again."""
    match error:
        case NgptError() | OSError():
            return str(error)
        case MemoryError():
            return "out of memory; use a smaller image or fewer files at once"
        case ImportError():
            return f"a library cannot be loaded, for want of memory or since the installation is broken: {error}"
    raise error


def _check_address_space() -> None:
    """Raises NgptError for a limit (``ulimit -v``) at which OpenBLAS and other libraries would hang or abort."""
    limit = address_space()
    if limit is not None and limit < FEWEST_MIB << 20:
        raise NgptError(f"the address space has only {limit >> 20} MiB (ulimit -v); ngpt needs at least {FEWEST_MIB}")


def tell(line: str) -> None:
    """Prints a line of the result on standard output."""
    print(printable(line))


def print_line(text: str, stream: TextIO) -> None:
    """Prints a message without buffering. If it cannot be written, as on a full disk, the work goes on."""
    try:
        print(printable(text), file=stream, flush=True)
    except RuntimeError:
        # A signal handler prints this line. It has interrupted another print, and the buffer is not reentrant.
        os.write(stream.fileno(), f"{printable(text)}\n".encode(errors="backslashreplace"))
    except OSError:
        _close(stream)


def _close(stream: TextIO) -> None:
    """Discards the contents of the stream's buffer and all further output."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def _open_standard_streams() -> None:
    """Opens standard streams that are closed.

    If a stream stayed closed, a file opened later would get its number, and printed text would go into that file.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    # Standard output may not be able to encode all text from files: on Windows, pipes use a local code page.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


@contextmanager
def _own_stderr() -> Iterator[None]:
    """Gives messages a descriptor of their own, because descriptor 2 leads nowhere while any thread reads OpenEXR."""
    stream = sys.stderr
    if type(stream) is not io.TextIOWrapper or stream.fileno() != 2:  # the stream of a test or a notebook
        yield
        return
    with open(os.dup(2), "w", buffering=1, encoding=stream.encoding, errors=stream.errors) as sys.stderr:
        try:
            yield
        finally:
            sys.stderr = stream


class _Handler(logging.Handler):
    """Prints log records to the current standard error, above a progress bar if there is one; each warning once."""

    def __init__(self) -> None:
        super().__init__()
        self._warnings: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.WARNING:
            if (text := record.getMessage()) in self._warnings:
                return
            self._warnings.add(text)
        print_line(self.format(record), sys.stderr)


@contextmanager
def logged(verbose: bool, quiet: bool = False) -> Iterator[None]:
    """In the block, prints warnings of the logger "ngpt"; all its messages if ``verbose``, only errors if ``quiet``."""
    logger, handler = logging.getLogger("ngpt"), _Handler()
    handler.setFormatter(logging.Formatter("%(relativeCreated)7.0f ms  %(name)s: %(message)s" if verbose else None))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if verbose else logging.ERROR if quiet else logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


class Console:
    """Prints messages and progress of a command; only errors if ``quiet``. Messages of errors begin with ``name``."""

    def __init__(self, quiet: bool = False, name: str = "ngpt"):
        self.quiet, self.name = quiet, name

    def say(self, text: str) -> None:
        if not self.quiet:
            print_line(text, sys.stderr)

    def error(self, text: object) -> None:
        print_line(f"{self.name}: error: {' '.join(str(text).split())}", sys.stderr)

    @property
    def terminal(self) -> bool:
        """Whether progress is shown on a terminal."""
        return not self.quiet and sys.stderr.isatty()

    @contextmanager
    def progress(
        self, label: str, unit: str, rate: bool = False, begins: str = ""
    ) -> Iterator[Callable[[int, int], None]]:
        """Yields ``update(done, total)``. Its first call starts the clock and counts ``done`` as work of earlier runs.

        ``rate`` is whether units per second are shown. ``begins`` is a phrase that is shown until the second call.
        """
        if self.quiet:
            yield lambda done, total: None
        elif self.terminal:
            with _bar(printable(label), unit, _Pace(unit, rate, begins)) as update:
                yield update
        else:
            yield _Lines(self, label, unit, _Pace(unit, rate, begins))


class _Pace:
    """Estimates the time left from the pace in the later half of the elapsed time, where cached units soon drop out."""

    def __init__(self, unit: str, rate: bool, begins: str):
        self.unit, self.rate, self.begins = unit, rate, begins
        self.start, self.elapsed = 0.0, 0.0
        # Pairs (seconds, done). The first pair is from half of the elapsed time or earlier.
        self.past: deque[tuple[float, int]] = deque()

    def __call__(self, done: int, total: int) -> list[str]:
        """Phrases about the pace, of a few words each."""
        if not self.past:
            self.start = time.monotonic()
            self.past.append((0.0, done))
            return [self.begins] if self.begins and done < total else []
        self.elapsed = time.monotonic() - self.start
        while len(self.past) > 1 and self.past[1][0] <= self.elapsed / 2:
            self.past.popleft()
        then, before = self.past[0]
        pace = (done - before) / (self.elapsed - then) if self.elapsed > then else 0.0
        if self.elapsed > 1.01 * self.past[-1][0]:
            self.past.append((self.elapsed, done))
        words = [f"{pace:{'.0f' if pace >= 100 else '.3g'}} {self.unit}/s"] if self.rate and pace else []
        if pace and done < total:
            words.append(f"about {span((total - done) / pace)} left")
        return words


def brief(value: float) -> str:
    """A positive number with two digits, or as a whole number from 10 on: 0.35, 4.2, 126."""
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def span(seconds: float) -> str:
    """A rough duration: "40 s", "12 min", "2.5 h"."""
    for unit, size in (("s", 1), ("min", 60)):
        if seconds < 100 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 3600:.1f} h"


@contextmanager
def _bar(label: str, unit: str, pace: _Pace) -> Iterator[Callable[[int, int], None]]:
    # Imported only here, so that commands without a terminal start faster.
    from rich.console import Console as Terminal
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

    terminal = Terminal(stderr=True)
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
        TextColumn("{task.fields[pace]}"),
    ]
    phrase: Callable[[list[str]], str] = ", ".join
    taken = WIDE + (RATE if pace.rate else 0)
    if terminal.width < taken + LABEL:
        # A narrow terminal shows only the progress and the time left.
        columns, phrase, taken = [columns[0], columns[2], columns[5]], _last, NARROW
    label = _shortened(label, terminal.width - taken)
    # Lines on standard output are shown above the bar, unless they go into a file.
    with Progress(*columns, console=terminal, redirect_stdout=sys.stdout.isatty()) as progress:
        task = progress.add_task(label, total=None, pace="", start=False)

        def update(done: int, total: int) -> None:
            progress.start_task(task)
            progress.update(task, completed=done, total=total, pace=phrase(pace(done, total)))

        yield update


def _shortened(text: str, most: int) -> str:
    """The text with at most ``most`` letters. It is cut at its start, because names differ at their ends."""
    return text if len(text) <= most else f"…{text[len(text) - most + 1 :]}" if most > 1 else ""


def _last(words: list[str]) -> str:
    """The last phrase about the pace, which is the time left."""
    return words[-1].removeprefix("about ") if words else ""


class _Lines:
    """Prints progress as lines of text: the first, the last, and some between them."""

    def __init__(self, console: Console, label: str, unit: str, pace: _Pace):
        self.console, self.label, self.unit, self.pace = console, label, unit, pace
        self.first: int | None = None
        self.last, self.printed = 0.0, (-1, -1)

    def __call__(self, done: int, total: int) -> None:
        words, elapsed = self.pace(done, total), self.pace.elapsed
        begun, self.first = self.first is not None, done if self.first is None else self.first
        if begun and done != total and elapsed - self.last < max(SECONDS_BETWEEN_LINES, elapsed / LINES):
            return
        if done == total and (done, total) == self.printed:
            return
        self.last, self.printed = elapsed, (done, total)
        times = [f"{elapsed:.1f} s"] if done > self.first else []
        self.console.say(", ".join([f"{self.label}: {done}/{total} {self.unit}", *times, *words]))
