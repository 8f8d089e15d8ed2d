"""``ngpt render --live``: shows the image on a page during the render, within a small share of its time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ngpt.errors import NgptError, stop_if_interrupted
from ngpt.report.live import LivePage
from ngpt.report.preview import preview
from ngpt.stack import GradientStack
from ngpt.system.console import Console

# The share of the render's time that making and sending images may take. The first image may use up half of it for the
# whole render.
SHARE, _AHEAD = 0.02, 0.5
_CAUTION = 1.5
# Seconds that the first image is expected to take: to load the method, and for a pixel.
_LOAD, _PIXEL = 0.1, 3e-6


class Onlookers:
    """The page of a render, if there is one. Without a page these functions cost nothing.

    ``data_gen.render_scene`` calls ``newest`` after each pass, and ``progress`` with the progress.
    """

    def __init__(self, page: LivePage | None, say: Callable[[str], None], unit: str):
        self.page, self.say, self.unit = page, say, unit
        self.line, self.shown, self.failed = "ended without an image", False, False
        self.start, self.spent, self.expected, self.left = time.perf_counter(), 0.0, 0.0, 0.0

    @property
    def enough(self) -> bool:
        return self.page is not None and self.page.enough

    def progress(self, done: int, total: int) -> None:
        """The progress of the render: (samples done, samples), or whole (seconds gone, seconds)."""
        gone = time.perf_counter() - self.start
        self.left = gone * (total - done) / done if done else 0.0
        if self.page is not None and not self.page.ended:
            left = f", about {self.left:.0f} s left" if self.left >= 1 else ""
            far = (
                f"{gone:.0f} of {total} s" if self.unit == "s" else f"{done} of {total} samples per pixel, {gone:.0f} s"
            )
            self.page.tell(far + left)

    def newest(self, stack: Callable[[], GradientStack]) -> None:
        """Shows the samples done so far, if somebody has opened the page and time allows."""
        if not self._watched():
            return
        begin = time.perf_counter()
        with self._harmless():
            made = None
            if not self.expected:
                made = stack()
                self.expected = _LOAD + _PIXEL * made.width * made.height
            gone = begin - self.start
            if not self.shown:
                # The expected time of the whole render counts, but only a part of it, since it is not known well yet.
                gone = max(gone, _AHEAD * (gone + self.left))
            if self.spent + self.expected <= SHARE * gone:
                self.shown = True
                try:
                    self._show(made or stack())
                finally:
                    # On a busy machine the next image may take longer.
                    self.expected = _CAUTION * (time.perf_counter() - begin)
        self.spent += time.perf_counter() - begin

    def last(self, stack: GradientStack, line: str) -> None:
        """Shows the stack, which has been written, and prints a last line."""
        self.line = line
        if self._watched():
            with self._harmless():
                self._show(stack)

    def close(self) -> None:
        with self._harmless():
            if self.page is not None:
                self.page.close(self.line)

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """A context in which no failure, of a method or for lack of memory, ends the render. The first is reported."""
        try:
            yield
        except Exception as error:
            stop_if_interrupted(error)
            if not self.failed:
                self.say(f"no live image: {error or type(error).__name__}; the render goes on")
            self.failed = True

    def _watched(self) -> bool:
        return self.page is not None and self.page.watched

    def _show(self, stack: GradientStack) -> None:
        if self.page is not None:
            size, attributes = f"{stack.width}x{stack.height}", stack.attributes
            line = f"{size}, {attributes['ngpt:spp']} samples per pixel, {attributes['ngpt:seconds']:.3g} s"
            self.page.show(preview(stack), line)


def onlookers(live: bool, scene: str, command: str, console: Console, unit: str) -> Onlookers:
    """Makes the page if it is requested. If that fails, a line says why, and the render goes on without a page."""
    page = None
    try:
        page = LivePage(f"{scene}, live", command) if live else None
    except (NgptError, RuntimeError, MemoryError) as error:  # no thread can be had for it
        console.error(f"{error}; the render goes on")
    if page is not None:
        console.say(f"live: {page.url}")
    return Onlookers(page, console.say, unit)
