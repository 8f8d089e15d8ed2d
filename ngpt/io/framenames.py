"""Names with a field for the frame's number: ``shot.%04d.exr``, ``shot.####.exr``, ``shot.$F4.exr``, ``<frame>``.

``{frame:04d}``, the form of ``ngpt render``, is a field too. The number in a field, or the count of #, is the least
number of digits. If a file with exactly this name exists, the name stands for that file.
"""

import glob
import os
import re
from pathlib import Path

from ngpt.errors import NgptError, WrongUse

_FIELD = re.compile(r"%(?:0(\d))?d|(##+)|\$F(\d?)|<frame>|\{frame(?::0(\d)d)?\}")
# A number in a name. A minus belongs to the number only at the start of a name and after a dot or an underscore: in
# "f.-2", but not in "f-2".
NUMBER = re.compile(r"((?:(?<![^._/\\])-)?[0-9]+)")


def varies(name: str) -> bool:
    """Whether a name contains a field for the frame's number, and is not the name of a file."""
    return bool(_FIELD.search(name)) and not os.path.exists(name)


def frames_named(name: str) -> dict[int, Path]:
    """The existing frames of a name with fields: number -> file, in order. Raises NgptError if there are none."""
    pattern, form, end = "", "", 0
    for field in _FIELD.finditer(name):
        before, least = name[end : field.start()], max(_digits(field), 1)
        pattern += f"{glob.escape(before)}*"
        # printf and Python count a minus as a digit.
        form += re.escape(before) + rf"(-\d{{{max(least - 1, 1)},}}|\d{{{least},}})"
        end = field.end()
    found = {}
    for path in glob.glob(pattern + glob.escape(name[end:])):
        match = re.fullmatch(form + re.escape(name[end:]), path)
        # All fields of a frame's name hold the same number.
        if match and len(numbers := set(map(int, match.groups()))) == 1:
            found[numbers.pop()] = Path(path)
    if not found:
        raise NgptError(f"{name}: no frames of that name exist; check the name")
    return dict(sorted(found.items()))


def named(name: str, frame: int) -> str:
    """The name of one frame, from a name with fields."""
    return _FIELD.sub(lambda field: f"{frame:0{_digits(field)}d}" if _digits(field) else str(frame), name)


def number_of(path: Path, wanted: str) -> int:
    """The frame of a file: the last number in its name.

    Raises WrongUse if there is none; the message names ``wanted``, the name with fields that needs the number.
    """
    numbers = NUMBER.findall(path.stem)
    if not numbers:
        raise WrongUse(f"{path}: has no number, which {wanted} asks for; give an output name without a frame number")
    return int(numbers[-1])


def _digits(field: re.Match) -> int:
    """The least number of digits, 0 if none is given."""
    printf, hashes, houdini, ours = field.groups()
    return len(hashes) if hashes else int(printf or houdini or ours or 0)
