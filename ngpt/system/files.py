"""Writes output files so that an incomplete file never has the final name."""

import os
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from threading import Lock

from ngpt.errors import NgptError
from ngpt.system.forks import hold_while_forking

try:
    import fcntl
except ImportError:  # Windows, where a lock would keep its own holder from writing the file
    fcntl = None  # type: ignore[assignment]

# Temporary files have recognisable names, so that files of killed processes can be found.
_PREFIX = ".ngpt-"
_LEFTOVER = re.compile(r"\.ngpt-[a-z0-9_]{8}(\.[^.]*)?")
_MOST = 99  # other names that are tried for a file that cannot be written
_one_at_a_time = Lock()
hold_while_forking(_one_at_a_time)
# Seconds since the last change after which temporary files are removed on systems without locks
_FORGOTTEN = 24 * 3600.0


def make_folder(folder: str | os.PathLike) -> Path:
    """Makes a folder and its parents if they do not exist. Raises NgptError if that is impossible."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NgptError(f"{folder}: cannot be made: {error.strerror}; name another folder") from error
    return Path(folder)


def check_output(path: str | os.PathLike, overwrite: bool = False, may_skip: bool = False) -> Path:
    """Returns ``path`` as a Path. Raises NgptError if no file may be written there.

    It is called before long work starts, so that an hour of rendering is not lost to a typing error. With ``may_skip``,
    the message also names the option that leaves existing files out.
    """
    path = Path(path)
    if path.is_dir():
        raise NgptError(f"{path}: is a directory; name a file to write")
    if path.exists() and not overwrite:
        skip = ", or --skip-existing (skip_existing=True) to leave it out" if may_skip else ""
        raise NgptError(f"{path}: exists already; pass --force (overwrite=True) to replace it{skip}")
    if not path.parent.is_dir():
        raise NgptError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise NgptError(f"{path}: the folder {path.parent} is not writable")
    return path


def save(
    path: str | os.PathLike, write: Callable[[Path, bool], object], overwrite: bool = False, *, alike: bool = False
) -> None:
    """Calls ``write(path, overwrite)``. If it fails, writes the file elsewhere, and raises NgptError that says where.

    This is for results that took long to make. The other places, in order, are another name beside ``path``
    ("a.kept.exr" for "a.exr"), the working directory, and the folder for temporary files. Nothing is overwritten there.
    ``write`` must write a complete file or none, as ``atomic_output`` does.

    ``alike`` means that several processes write the same file to this folder, and that every file in the folder counts
    as data. Then a file that exists at ``path`` by now is accepted, and no file is put beside ``path``.
    """
    path = Path(path)
    try:
        write(path, overwrite)
    except (NgptError, OSError) as error:
        if alike and path.is_file():
            return
        for other in _other_places(path, not alike):
            try:
                write(other, False)
            except (NgptError, OSError):
                continue
            raise NgptError(f"{error}; what was made is kept in {other}") from error
        raise NgptError(f"{error}; nor can it be written elsewhere, so it is lost") from error


def _other_places(path: Path, beside: bool) -> Iterator[Path]:
    """A free path in each of the other folders for a file that cannot be written to ``path``."""
    names = [f"{path.stem}.kept{f'-{n}' if n > 1 else ''}{path.suffix}" for n in range(1, _MOST + 1)]
    folders: list[Callable[[], str | Path]] = [Path.cwd, tempfile.gettempdir]
    for find in [lambda: path.parent, *folders] if beside else folders:
        with suppress(OSError):  # a working directory that was removed, or no folder for temporary files
            folder = Path(find())
            free = (folder / name for name in names if not os.path.lexists(folder / name))
            yield from islice(free, 1)


@contextmanager
def atomic_output(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Yields a temporary path beside ``path`` and renames it to ``path`` when the block succeeds.

    The temporary file has the suffix of ``path``, is flushed to disk before the rename, and is removed if the block
    fails. The block must write into that file, not replace it. If ``path`` is a link, its target is written. A killed
    process leaves a hidden temporary file. The next process that writes into the folder removes it, on Windows when it
    is a day old.

    Raises NgptError if the file cannot be written, or if another writer has made the same new file first.
    """
    path = check_output(path, overwrite)
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = handle = None
    try:
        _sweep(path.parent.absolute())
        temporary, handle = _temporary(path)
        yield temporary
        with open(temporary, "r+b") as file:  # Windows flushes only what may be written
            os.fsync(file.fileno())
        # mkstemp makes private files. This file gets the permissions that open() would have given it.
        os.chmod(temporary, 0o666 & ~_umask())
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


def _umask() -> int:
    """The umask of the process. It can only be read by setting it, and two threads at once could leave it at 0."""
    with _one_at_a_time:
        umask = os.umask(0)
        os.umask(umask)
    return umask


def _temporary(path: Path) -> tuple[Path, int | None]:
    """A new file beside ``path``, and a handle whose lock shows other processes that the writer is alive.

    On systems without locks, the handle is None.
    """
    while True:
        handle, name = tempfile.mkstemp(prefix=_PREFIX, suffix=path.suffix, dir=path.parent)
        if fcntl is None:
            os.close(handle)
            return Path(name), None
        with suppress(OSError):  # a file system without locks, where no process removes temporary files either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.path.exists(name):
            return Path(name), handle
        # Another process removed the file before it was locked.
        os.close(handle)


@lru_cache(maxsize=1024)
def _sweep(folder: Path) -> None:
    """Removes temporary files of dead writers, once per process and folder, since a folder may hold many files."""
    with suppress(OSError):  # a folder that cannot be listed
        for name in filter(_LEFTOVER.fullmatch, os.listdir(folder)):
            with suppress(OSError):
                _remove_abandoned(folder / name)


def _remove_abandoned(path: Path) -> None:
    """Removes a temporary file. Raises OSError if its writer is alive."""
    if fcntl is None:
        if time.time() - path.lstat().st_mtime > _FORGOTTEN:
            path.unlink()
        return
    handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    finally:
        os.close(handle)


def _publish(temporary: Path, path: Path, overwrite: bool) -> None:
    """Gives a finished file its name. Raises NgptError if another writer was faster and ``overwrite`` is False."""
    if not overwrite:
        try:
            os.link(temporary, path)  # unlike a rename, it fails if the name is taken
            return
        except FileExistsError:
            check_output(path)
        except OSError:  # a file system without hard links
            check_output(path)
    os.replace(temporary, path)


def _sync_folder(folder: Path) -> None:
    """Flushes the folder to disk, so that the new name survives a power cut."""
    with suppress(OSError):  # some file systems cannot do it, and Windows cannot open folders
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def exclusive(folder: str | os.PathLike, wait: bool = False) -> Iterator[None]:
    """Keeps other processes that call this function out of ``folder`` during the block.

    If another process is in its block, raises NgptError, or waits if ``wait`` is True. The lock ends with the process,
    even if processes that it forked go on.
    """
    with warnings.catch_warnings():
        # filelock warns if the system cannot lock files, and uses a file with the process number instead.
        warnings.simplefilter("ignore")
        from filelock import FileLock, Timeout  # only here, since denoising locks no folder

        lock = FileLock(Path(folder) / ".lock", blocking=wait)
        try:
            os.stat(folder)  # raises if the folder does not exist; FileLock would make it
            lock.acquire()
        except Timeout as error:
            raise NgptError(f"{folder}: another process is writing there; wait, or name another folder") from error
        except OSError as error:
            raise NgptError(f"{folder}: cannot be written: {error.strerror or error}; name another folder") from error
    try:
        yield
    finally:
        lock.release()
