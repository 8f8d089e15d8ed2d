"""Frames on a command line: which ones, and the file of each."""

import argparse
import re
from pathlib import Path

from data_gen.frames.pattern import filled, varies
from ngpt.cli.picture import IMAGES
from ngpt.errors import WrongUse

# More than anyone renders; a typing error must not fill the memory.
_MOST = 1_000_000


def frames(text: str) -> list[int]:
    """``0:120`` (120 is not in it), ``0:120:2``, ``7``, or several of them with commas between; in order.

    And as farms write them, with the last one in it: ``1-10``, ``1-9x2``, ``1-9:2``.
    """
    numbers: dict[int, None] = {}
    for part in text.split(","):
        try:
            values = _of_a_farm(part) or [int(number) for number in part.split(":")]
        except ValueError:
            values = []
        if len(values) not in (1, 2, 3):
            raise argparse.ArgumentTypeError(
                f"'{part}' is no frame; write 7, 0:120 (120 is not in it), 0:120:2, or 0-119 (119 is in it)"
            )
        found = range(values[0], values[0] + 1) if len(values) == 1 else range(*values) if 0 not in values[2:] else ()
        if not found or len(found) > _MOST:
            raise argparse.ArgumentTypeError(f"'{part}' are {len(found)} frames; write START:END or START:END:STEP")
        numbers.update(dict.fromkeys(found))
    return list(numbers)


def _of_a_farm(part: str) -> list[int]:
    """First, end and step of ``1-10``, whose end is in it; [] for anything else."""
    match = re.fullmatch(r"(-?\d+)-(-?\d+)(?:[x:](-?\d+))?", part)
    if not match:
        return []
    step = int(match[3] or 1)
    return [int(match[1]), int(match[2]) + (1 if step > 0 else -1), step]


def targets(output: str | None, scene: str, numbers: list[int]) -> dict[int, Path]:
    """Frame -> file. ``output`` is a pattern (``shot.{frame:04d}.exr``), or a folder, which need not be there.

    Raises WrongUse for a name that is one file for several frames.
    """
    stem = re.sub(r"[._-]*\{[^{}]*\}", "", Path(scene).stem) or "frame"
    pattern = output if output is not None else f"{stem}.{{frame:04d}}.exr"
    if not varies(pattern):
        folder = Path(pattern)
        if folder.suffix.lower() in IMAGES and not folder.is_dir():
            if len(numbers) > 1:
                named = f"{folder.with_suffix('')}.{{frame:04d}}{folder.suffix}"
                raise WrongUse(f"{folder}: is one file for {len(numbers)} frames; write -o '{named}', or a folder")
            return {numbers[0]: folder}
        pattern = str(folder / f"{stem}.{{frame:04d}}.exr")
    found = {number: Path(filled(pattern, number)) for number in numbers}
    seen: dict[Path, int] = {}
    for number, path in found.items():
        if (other := seen.setdefault(path, number)) != number:
            raise WrongUse(f"{path}: would be frame {other} and frame {number}; write {{frame:04d}} in the name")
    return found
