"""Names of a shot's frames as studios write them: ``shot.%04d.exr``, ``shot.####.exr``, ``shot.$F4.exr``, ``<frame>``.

``{frame:04d}``, the form of ``ngpt render``, is accepted too. The number after % or $F, or the count of #, is the least
number of digits. If a file has exactly such a name, the name means that file, as with other patterns.
"""

import glob
import os
import re
from pathlib import Path

from ngpt.errors import NgptError, WrongUse

_FIELD = re.compile(r"%(?:0(\d))?d|(##+)|\$F(\d?)|<frame>|\{frame(?::0(\d)d)?\}")


# A number in a name. A minus belongs to it after a dot, an underscore or at the start: "f.-2", but not "f-2".
NUMBER = re.compile(r"((?:(?<![^._/\\])-)?[0-9]+)")


def varies(name: str) -> bool:
    """Whether a name contains a field for the number of the frame."""
    return bool(_FIELD.search(name)) and not os.path.exists(name)


def frames_named(name: str) -> dict[int, Path]:
    """The existing files of a name that varies: number -> file, in order. Raises NgptError if there are none."""
    pieces, form, end = [], "", 0
    for field in _FIELD.finditer(name):
        pieces.append(name[end : field.start()])
        least = max(_digits(field), 1)
        # printf and Python count a minus as a digit.
        form += re.escape(pieces[-1]) + rf"(-\d{{{max(least - 1, 1)},}}|\d{{{least},}})"
        end = field.end()
    pieces.append(name[end:])
    form += re.escape(pieces[-1])
    found = {}
    for path in glob.glob("*".join(map(glob.escape, pieces))):
        match = re.fullmatch(form, path)
        # A frame's name holds the same number in all fields.
        if match and len(numbers := set(map(int, match.groups()))) == 1:
            found[numbers.pop()] = Path(path)
    if not found:
        raise NgptError(f"{name}: no frames of that name are there; check the name")
    return dict(sorted(found.items()))


def named(name: str, frame: int) -> str:
    """The name of one frame, from a name that varies."""
    return _FIELD.sub(lambda field: f"{frame:0{_digits(field)}d}" if _digits(field) else str(frame), name)


def number_of(path: Path, wanted: str) -> int:
    """A file's frame: the last number in its name. Raises WrongUse, naming ``wanted``, if there is none."""
    numbers = NUMBER.findall(path.stem)
    if not numbers:
        raise WrongUse(f"{path}: has no number, which {wanted} asks for; give an output name without a frame number")
    return int(numbers[-1])


def _digits(field: re.Match) -> int:
    """The least number of digits, 0 if none is given."""
    printf, hashes, houdini, ours = field.groups()
    return len(hashes) if hashes else int(printf or houdini or ours or 0)
