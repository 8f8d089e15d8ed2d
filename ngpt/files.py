"""Output files: complete under their final name, or not there at all."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ngpt.errors import NgptError


def check_output(path: str | os.PathLike, overwrite: bool = False) -> Path:
    """Returns ``path`` as a Path if a file may be written there, else raises NgptError.

    Called before long work starts, so that an hour of rendering is not lost to a typing error.
    """
    path = Path(path)
    if path.is_dir():
        raise NgptError(f"{path}: is a directory; name a file to write")
    if path.exists() and not overwrite:
        raise NgptError(f"{path}: exists already; pass --force (overwrite=True) to replace it")
    if not path.parent.is_dir():
        raise NgptError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise NgptError(f"{path}: the folder {path.parent} is not writable")
    return path


@contextmanager
def atomic_output(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Yields a temporary path beside ``path`` and renames it to ``path`` when the block succeeds.

    The temporary file keeps the suffix of ``path`` (writers choose the format by it), is flushed to disk before the
    rename, and is removed when the block fails, so nobody ever sees half a file under the final name.
    """
    path = check_output(path, overwrite)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        # mkstemp makes private files; give the result the permissions that open() would have given it.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        # Another writer may have finished since the first check, and os.replace would silently discard its work.
        check_output(path, overwrite)
        os.replace(temporary, path)
    except OSError as error:
        raise NgptError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def exclusive(folder: str | os.PathLike) -> Iterator[None]:
    """Keeps other processes out of ``folder`` for the length of the block; raises NgptError if one is at work there.

    The lock goes with the process, however it ends.
    """
    with open(Path(folder) / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise NgptError(
                f"{folder}: another process is writing there; wait for it, or name another folder"
            ) from error
        yield
