"""What the command line says while it works: a progress bar on a terminal, plain lines elsewhere.

Everything goes to standard error; standard output is kept for results (JSON, tables).
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Elsewhere than on a terminal, a line at most this often: a log should show life, not fill up.
SECONDS_BETWEEN_LINES = 5.0


class Console:
    """Messages and progress for one command. ``quiet`` leaves only errors."""

    def __init__(self, quiet: bool = False):
        self.quiet = quiet

    def say(self, text: str) -> None:
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def error(self, text: object) -> None:
        print(f"ngpt: error: {' '.join(str(text).split())}", file=sys.stderr, flush=True)

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
