"""Output files: complete under their final name, or not there at all."""

import fcntl
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from ngpt.errors import NgptError

# Temporary files have names of their own, so that what killed processes leave behind is known for what it is.
_PREFIX = ".ngpt-"
_LEFTOVER = re.compile(r"\.ngpt-[a-z0-9_]{8}(\.[^.]*)?")


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
    rename, and is removed when the block fails, so nobody ever sees half a file under the final name. The block has to
    write into that file, not replace it. A process that is killed leaves its temporary file behind, hidden; the next
    one that writes into the folder removes it.

    Raises NgptError when the file cannot be written; of several writers of one new file all but the first.
    """
    path = check_output(path, overwrite)
    temporary = handle = None
    try:
        _sweep(path.parent.absolute())
        temporary, handle = _temporary(path)
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        # mkstemp makes private files; give the result the permissions that open() would have given it.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        _publish(temporary, path, overwrite)
        _sync_folder(path.parent)
    except OSError as error:
        raise NgptError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)


def _temporary(path: Path) -> tuple[Path, int]:
    """A new file beside ``path``, and a handle whose lock tells other processes that its writer lives."""
    while True:
        handle, name = tempfile.mkstemp(prefix=_PREFIX, suffix=path.suffix, dir=path.parent)
        with suppress(OSError):  # a file system without locks, on which nobody sweeps either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.path.exists(name):
            return Path(name), handle
        # Swept away between its making and its locking.
        os.close(handle)


@lru_cache(maxsize=1024)
def _sweep(folder: Path) -> None:
    """Removes temporary files whose writers are dead; once in a process, for a folder may hold very many files."""
    with suppress(OSError):  # what cannot be listed cannot be swept
        for name in filter(_LEFTOVER.fullmatch, os.listdir(folder)):
            with suppress(OSError):
                handle = os.open(folder / name, os.O_RDWR | os.O_NOFOLLOW)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(folder / name)
                finally:
                    os.close(handle)


def _publish(temporary: Path, path: Path, overwrite: bool) -> None:
    """Gives a finished file its name; raises NgptError where another writer was faster and is not to be replaced."""
    if not overwrite:
        try:
            os.link(temporary, path)  # which a rename is not: refused when the name is taken
            return
        except FileExistsError:
            check_output(path)
        except OSError:  # a file system without hard links
            check_output(path)
    os.replace(temporary, path)


def _sync_folder(folder: Path) -> None:
    """Has the new name outlive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # file systems that cannot
            os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def exclusive(folder: str | os.PathLike, wait: bool = False) -> Iterator[None]:
    """Keeps other processes out of ``folder`` for the length of the block.

    Raises NgptError if one is at work there, or with ``wait`` waits until it is done. The lock goes with the process,
    however it ends, though processes that it forked live on.
    """
    try:
        handle = os.open(Path(folder) / ".lock", os.O_WRONLY | os.O_CREAT, 0o666)
    except OSError as error:
        raise NgptError(f"{folder}: cannot be written: {error.strerror or error}; name another folder") from error
    _locks.add(handle)
    try:
        _lock(handle, folder, wait)
        yield
    finally:
        _locks.discard(handle)
        os.close(handle)


def _lock(handle: int, folder: str | os.PathLike, wait: bool) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError as error:
        raise NgptError(f"{folder}: another process is writing there; wait for it, or name another folder") from error
    except OSError as error:
        raise NgptError(f"{folder}: cannot be locked: {error.strerror or error}; name a folder elsewhere") from error


# A forked process, such as a worker of a data loader, holds its parent's locks as long as it has their handles.
_locks: set[int] = set()


def _let_go() -> None:
    for handle in _locks:
        os.close(handle)
    _locks.clear()


os.register_at_fork(after_in_child=_let_go)
