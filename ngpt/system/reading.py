"""Opens input files, which must be regular files, and reads them up to a sensible size."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ngpt.errors import NgptError

MOST_TEXT = 2**28  # bytes of a configuration or a record
_AT_ONCE = getattr(os, "O_NONBLOCK", 0)  # Windows does not have it


@contextmanager
def regular_file(path: Path) -> Iterator[BinaryIO]:
    """Opens a file for reading. Raises NgptError if it is missing or unreadable, and for pipes, devices and folders."""
    try:
        # Without O_NONBLOCK, a pipe without a writer would make ``open`` wait.
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _AT_ONCE))  # noqa: SIM115
    except FileNotFoundError:
        raise NgptError(f"{path}: not found; check the name") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a zero in it
        if os.path.isdir(path):  # not every system's error says so
            raise NgptError(f"{path}: is a directory; name a file in it") from None
        raise NgptError(f"{path}: cannot be read: {getattr(error, 'strerror', '') or error}") from error
    with file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise NgptError(f"{path}: is a pipe or a device, no file; save it to disk first")
        try:
            yield file
        except OSError as error:
            raise NgptError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_bytes(path: str | Path, most: int) -> bytes:
    """The contents of a regular file. Raises NgptError if it cannot be read, or has more than ``most`` bytes."""
    with regular_file(Path(path)) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise NgptError(f"{path}: is larger than {most >> 20} MiB, the most that is read of such a file")
    return data


def read_text(path: str | Path) -> str:
    """The text of a regular file, at most ``MOST_TEXT`` bytes of UTF-8; raises NgptError for anything else."""
    try:
        return read_bytes(path, MOST_TEXT).decode("utf-8")
    except UnicodeDecodeError as error:
        raise NgptError(f"{path}: cannot be read: {error}") from error
