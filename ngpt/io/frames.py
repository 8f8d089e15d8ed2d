"""The frames of a shot in a folder or by a pattern, in the order of their numbers."""

import glob
import os
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from ngpt.errors import NgptError
from ngpt.io.framenames import NUMBER, frames_named, varies
from ngpt.io.header import read_headers
from ngpt.system.reading import regular_file

# The suffix that `ngpt denoise` appends to the name of its input. Files with this suffix are results.
RESULT_SUFFIX = "_denoised"


class Series(NamedTuple):
    """Files whose names differ in one number, in order, and these numbers. ``name`` has # in place of the number."""

    name: str
    files: list[Path]
    numbers: list[int]


def natural(name: object) -> tuple:
    """A sort key that compares numbers in names as numbers: f.2 comes before f.10, and f.-2 before f.-1."""
    path = Path(str(name))
    texts = NUMBER.split(str(path.with_suffix("")))
    return tuple(int(text) if i % 2 else text for i, text in enumerate(texts)), path.suffix, str(path)


def is_shot(name: str) -> bool:
    """Whether a name stands for several files: a folder, a name with a field for frames, or a pattern.

    A pattern that is also the name of a file stands for that file.
    """
    return Path(name).is_dir() or varies(name) or (glob.has_magic(name) and not Path(name).exists())


def shot_files(name: str) -> list[Path]:
    """The frames of a folder (its .exr files) or of a pattern, in order.

    Patterns are shell patterns or names with fields (``ngpt.io.framenames``). A folder that exists is taken literally,
    also in a pattern: ``dir[1]/*.exr``. Hidden files such as macOS's ``._*``, and results in the folder of their inputs
    (``*_denoised``), are left out. Raises NgptError if there are no frames.
    """
    if found := without_results(_files(name)):
        return in_order(found)
    raise NgptError(f"{name}: no .exr files there")


def input_files(name: str) -> list[Path]:
    """The files to denoise: like ``shot_files``, but without any results of ``ngpt denoise``."""
    if found := [path for path in _files(name) if not path.stem.endswith(RESULT_SUFFIX)]:
        return in_order(found)
    raise NgptError(f"{name}: no .exr files to denoise there; name other formats, such as '*.pfm'")


def without_results(files: Sequence[Path]) -> list[Path]:
    """The files without those results whose inputs are also among the files."""
    results = {path.with_name(f"{path.stem}{RESULT_SUFFIX}{path.suffix}") for path in files}
    return [path for path in files if path not in results]


def frame_name(path: Path) -> str:
    """The name of a file without its ending and without the suffix of results: all files of a frame share it."""
    return path.stem.removesuffix(RESULT_SUFFIX)


def in_order(files: Iterable[Path]) -> list[Path]:
    """Files in the order of their frames: by the attribute ``ngpt:frame`` if all files have it and differ in it.

    Otherwise, files whose names differ in only one number form a series, and the series follow one another. In a
    series, files are in the order of the attribute if all have it, and otherwise in the order of their names.
    """
    given = list(files)
    frames = {path: frame for path in given if (frame := _frame(path)) is not None} if len(given) > 1 else {}
    if len(frames) == len(given) == len(set(frames.values())):
        return sorted(given, key=lambda path: frames[path])
    ordered = []
    for one in series(given):
        known = all(path in frames for path in one.files)
        ordered += sorted(one.files, key=lambda path: frames[path]) if known else one.files
    return ordered


def series(files: Iterable[Path]) -> list[Series]:
    """The series among files, in natural order of their first names.

    If a name has several numbers, like ``take2.0007``, the frame's number is the last one that differs among similar
    names.
    """
    alike: dict[str, list[Path]] = {}
    for path in sorted(files, key=natural):
        alike.setdefault(NUMBER.sub("#", path.stem) + path.suffix + str(path.parent), []).append(path)
    found: dict[str, Series] = {}
    for paths in alike.values():
        texts = [NUMBER.split(path.stem) for path in paths]
        places = range(1, len(texts[0]), 2)
        place = next((i for i in reversed(places) if len({int(text[i]) for text in texts}) > 1), None)
        for path, text in zip(paths, texts, strict=True):
            name, number = path.name, 0
            if place is not None:
                name = "".join([*text[:place], "#", *text[place + 1 :]]) + path.suffix
                number = int(text[place])
            one = found.setdefault(str(path.with_name(name)), Series(name, [], []))
            one.files.append(path)
            one.numbers.append(number)
    return list(found.values())


def remarks(name: str, files: Sequence[Path], results: bool = True) -> list[str]:
    """Warnings about the frames of a shot, one line each: omitted results, several series, missing numbers.

    ``name`` is the folder or pattern, ``files`` are its frames. ``results`` says whether omitted results are reported.
    """
    lines = []
    if left := len(set(_files(name)) - set(files)) if results else 0:
        pattern = (Path(name) if Path(name).is_dir() else Path(name).parent) / f"*{RESULT_SUFFIX}.exr"
        lines.append(f"{name}: {left} results beside their inputs are left out; '{pattern}' names them")
    found = series(files)
    if len(found) > 1 and len(files) > len(found):
        each = ", ".join(f"{one.name} ({len(one.files)})" for one in found)
        lines.append(f"{name}: {len(found)} series of frames, one after the other: {each}")
    for one in found:
        steps = list(pairwise(sorted(set(one.numbers))))
        step = min((after - before for before, after in steps), default=1)
        gaps = [(before + step, after - step) for before, after in steps if after - before > step]
        if gaps:
            some = ", ".join(str(first) if first >= last else f"{first} to {last}" for first, last in gaps[:5])
            some += f" and {len(gaps) - 5} more gaps" if len(gaps) > 5 else ""
            lines.append(f"{name}: {one.name} goes from {steps[0][0]} to {steps[-1][1]} without {some}")
    return lines


def _files(name: str) -> list[Path]:
    path = Path(name)
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() == ".exr"]
    elif varies(name):
        found = list(frames_named(name).values())
    else:
        found = [Path(file) for file in glob.glob(_with_literals(path), recursive=True)]
    return [file for file in found if not file.name.startswith(".")]


def _with_literals(path: Path) -> str:
    """A pattern in which leading folders that exist are escaped: ``dir[1]/*.exr``."""
    known, parts = Path(), []
    for part in path.parts:
        if not (known / part).exists():
            break
        known /= part
        parts.append(glob.escape(part))
    return os.path.join(*parts, *path.parts[len(parts) :])


def _frame(path: Path) -> float | None:
    """The attribute ``ngpt:frame`` of a file; None if it has none, or if its header cannot be read."""
    try:
        with regular_file(path) as file:
            numbers = [part.number("ngpt:frame") for part in read_headers(file, str(path))]
    except NgptError:
        return None
    return next((number for number in numbers if number is not None), None)
