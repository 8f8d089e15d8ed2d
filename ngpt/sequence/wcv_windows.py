"""Reconstructs a shot from gradients in space and in time: ``wcv`` over windows of frames.

Frames that have ``motion``, ``dt`` and ``dt_var`` are linked to the frame before. A window holds ``LENGTH`` linked
frames; the next window begins ``HOP`` frames later. A frame's result is the mean over its windows, weighted by the
frame's distance from their ends, so there is no jump between windows. The result depends on frames before and after,
but only within these windows.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np

from ngpt.classical.bases import CLASSICAL
from ngpt.coverage import kept_within
from ngpt.denoisers import caustic
from ngpt.errors import NgptError
from ngpt.magnitude import enlarged, magnitude, scaled
from ngpt.methods import METHODS, Result
from ngpt.repair import Repaired, repair
from ngpt.sequence.wcv_frames import Link, WindowFrame, wcv_frames
from ngpt.stack import GradientStack

LENGTH = 10
HOP = 5
# The layers that link a frame to the one before.
LINK = ("motion", "dt", "dt_var")


def reconstruct_shot(
    stacks: Iterable[GradientStack | None], wanted: Callable[[int], bool] = lambda i: True
) -> Iterator[tuple[int, GradientStack, Result]]:
    """Yields (number, stack, result by ``wcv`` over time) for each of the ``stacks`` that is ``wanted``, in their
    order.

    There is a cut before a stack that lacks a layer of ``LINK``, has another size, or whose ``ngpt:previousFrame`` is
    not the stack before; and where a stack is None. At most ``LENGTH`` stacks are in memory. Raises NgptError for
    stacks that lack a layer of ``wcv``.
    """
    run = _Run(wanted)
    before: GradientStack | None = None
    for number, stack in enumerate(stacks):
        shift = None if stack is None or before is None else _shift(stack, before)
        if shift is None:
            yield from run.end()
            run = _Run(wanted)
        if stack is not None:
            yield from run.add(_Member(number, stack, shift or (0, 0)))
        before = stack
    yield from run.end()


def _shift(stack: GradientStack, before: GradientStack) -> tuple[int, int] | None:
    """The position of the stack's first pixel in the one before; None at a cut."""
    frame, previous = before.number("ngpt:frame"), stack.number("ngpt:previousFrame")
    follows = previous is None or frame is None or previous == frame
    return stack.place.shift_in(before.place) if follows and all(name in stack for name in LINK) else None


class _Member:
    """A frame of a run, with the weighted sum of its results so far, in units of 2^power."""

    def __init__(self, number: int, stack: GradientStack, shift: tuple[int, int]):
        self.number, self.stack, self.shift, self.power = number, stack, shift, 0
        self.sum, self.weight, self.seconds = np.zeros(stack["primal"].shape), 0.0, 0.0

    @cached_property
    def frame(self) -> WindowFrame:
        data, stack = self.data, scaled(self.stack, self.power)
        light = CLASSICAL["wcv"](data)
        apart = np.zeros_like(light) if data.caustic is None else caustic.denoised(data)
        link = None
        if all(name in stack for name in LINK):
            link = Link(stack["motion"], stack["dt"], stack["dt_var"], self.shift)
        return WindowFrame(data.image, apart, data.dx, data.dy, data.variances, data.trusted, light + apart, link)

    @cached_property
    def data(self) -> Repaired:
        self.stack.require(*METHODS["wcv"].needs, why="method 'wcv'")
        return repair(scaled(self.stack, self.power))

    def result(self) -> tuple[int, GradientStack, Result]:
        image = enlarged((self.sum / self.weight + self.data.direct).astype(np.float32), self.power)
        if not np.isfinite(image).all():
            raise NgptError(f"{self.stack.path}: method 'wcv' over time gave non-finite pixels; scale the stacks down")
        image = kept_within(image, self.stack)
        return self.number, self.stack, Result(image, "wcv", self.seconds, self.data.pixels, self.data.gradients)


class _Run:
    """A series of linked frames, between two cuts."""

    def __init__(self, wanted: Callable[[int], bool]):
        self.wanted = wanted
        self.members: list[_Member] = []
        self.solved = 0  # the number of members that have been in a window
        self.power: int | None = None  # common to all frames, see ngpt.magnitude

    def add(self, member: _Member) -> Iterator[tuple[int, GradientStack, Result]]:
        self.members.append(member)
        if len(self.members) == LENGTH:
            self._solve()
            yield from self._give(HOP)

    def end(self) -> Iterator[tuple[int, GradientStack, Result]]:
        if self.solved < len(self.members):
            self._solve()
        yield from self._give(len(self.members))

    def _solve(self) -> None:
        self.solved = length = len(self.members)
        if not any(self.wanted(member.number) for member in self.members):
            return
        begun = time.perf_counter()
        if self.power is None:
            powers = [magnitude(member.stack) for member in self.members]
            self.power = sorted(powers)[length // 2]
        for member in self.members:
            member.power = self.power
        frames = [member.frame for member in self.members]
        images = wcv_frames(frames)
        seconds = (time.perf_counter() - begun) / length
        for place, (member, image) in enumerate(zip(self.members, images, strict=True)):
            weight = min(place + 1, length - place)
            member.sum += weight * image
            member.weight += weight
            member.seconds += seconds

    def _give(self, count: int) -> Iterator[tuple[int, GradientStack, Result]]:
        given, self.members = self.members[:count], self.members[count:]
        self.solved -= count
        for member in given:
            if self.wanted(member.number):
                yield member.result()
