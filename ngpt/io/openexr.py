"""Reads and writes OpenEXR files without changing their contents.

Parts, channels of all types, attributes of all types that Python's OpenEXR knows, data and display windows, tiles and
line order are kept. There are four exceptions (docs/use/gradient-stack.md): lossy compression becomes ZIP, only the
full-size level of a mipmap is kept, attributes that are empty lists are dropped, and rationals are reduced (48/2
becomes 24/1).

Deep images and subsampled channels are refused. OpenEXR holds whole files in memory. Of a damaged file, OpenEXR itself
would return only the readable parts; here a damaged file is an error. While a file is read, output of other threads to
stdout or stderr is lost, because OpenEXR's own messages are suppressed there.
"""

import contextlib
import io
import math
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR

from ngpt.errors import NgptError
from ngpt.io import openexr_copies
from ngpt.io.header import PartHeader, read_headers
from ngpt.system.files import atomic_output
from ngpt.system.forks import hold_while_forking
from ngpt.system.limits import free_address_space, processors
from ngpt.system.reading import regular_file

_LOSSY = {getattr(OpenEXR, f"{name}_COMPRESSION") for name in ("PXR24", "B44", "B44A", "DWAA", "DWAB", "LJ2K")}
_PIXEL_TYPES = (np.float16, np.float32, np.uint32)
_ATTRIBUTE_TYPES = (
    str,
    OpenEXR.Bytes,
    OpenEXR.Compression,
    OpenEXR.Envmap,
    OpenEXR.KeyCode,
    OpenEXR.LineOrder,
    OpenEXR.OpaqueAttribute,
    OpenEXR.PreviewImage,
    OpenEXR.Storage,
    OpenEXR.TileDescription,
    OpenEXR.TimeCode,
)
# The folder where Linux names open files by their numbers: opening such a name opens the same file again
_NUMBERS = Path("/proc/self/fd")
# Two calls at once would end each other's threads and mix up stdout and stderr. Since OpenEXR holds Python's lock, they
# would not be faster either.
_one_at_a_time = threading.Lock()
hold_while_forking(_one_at_a_time)
# MiB of address space that a thread may reserve for its stack and its part of the heap
_THREAD = 256
_FLOAT_MAX = float(np.finfo(np.float32).max)
openexr_copies.register()


@dataclass(frozen=True)
class ExrPart:
    """One part: its name ("" if it has none), its header as OpenEXR returns it, and its channels (H, W)."""

    name: str
    header: dict[str, Any]
    channels: dict[str, np.ndarray]


@dataclass(frozen=True)
class ExrImage:
    """The contents of an OpenEXR file."""

    parts: list[ExrPart]


def read_exr(path: str | os.PathLike) -> ExrImage:
    """Reads a file. Its size is checked before its pixels are decoded (``ngpt.io.header``).

    Raises NgptError if the file is missing, not a regular file, damaged, too large, deep or subsampled, or if it
    changes while it is read.
    """
    path = Path(path)
    with regular_file(path) as file:
        before = _state(file)
        headers = read_headers(file, str(path))
        for header in headers:
            if header.deep:
                raise NgptError(f"{path}: {header.label} is a deep image; flatten it, or render without deep output")
            for name, (_, step) in header.channels.items():
                if step != (1, 1):
                    where = f"{path}: channel '{name}' of {header.label}"
                    raise NgptError(f"{where} is subsampled {step[0]}x{step[1]}; save R G B at full size")
        try:
            parts = _decode(file, path, headers)
        finally:
            # A change of the file is the cause of any other error, so the change is reported instead.
            if _state(file) != before:
                raise NgptError(f"{path}: changed while it was read; wait until its writer is done, and read it again")
    return ExrImage(
        [
            ExrPart(part.name(), dict(part.header), {name: channel.pixels for name, channel in part.channels.items()})
            for part in parts
        ]
    )


def read_header(path: str | os.PathLike) -> tuple[dict[str, Any], tuple[int, int]]:
    """The attributes of the first part and its (width, height), without decoding pixels.

    Raises NgptError if the file is missing, damaged or too large.
    """
    path = Path(path)
    with regular_file(path) as file:
        size = read_headers(file, str(path))[0].size
        name = _numbered(file)
        try:
            with _without_native_stderr():
                return dict(OpenEXR.File(name, header_only=True).parts[0].header), size
        except Exception as error:
            raise NgptError(f"{path}: cannot be read ({_reason(error, name, path)}); copy it again") from error


def write_exr(path: str | os.PathLike, image: ExrImage, overwrite: bool = False) -> Path:
    """Writes ``image`` to ``path``, complete or not at all, and returns the path.

    Channels are float16, float32 or uint32 arrays (H, W) in any memory layout. Attributes are str, int (32 bits), float
    (stored with 32 bits), fractions.Fraction, lists of str or float, tuples and arrays as OpenEXR reads them, and
    OpenEXR's own types. Raises NgptError for values that a reader would not get back unchanged, and if the file cannot
    be written, or exists and ``overwrite`` is False.
    """
    if Path(path).suffix.lower() != ".exr":
        raise NgptError(f"{path}: ngpt writes OpenEXR; let the name end in .exr")
    parts = [_writable(part, str(path)) for part in image.parts]
    with atomic_output(path, overwrite) as temporary, _name_to_write(temporary) as name:
        try:
            with _one_at_a_time, _all_cores():
                OpenEXR.File([OpenEXR.Part(*part) for part in parts]).write(name)
        except Exception as error:
            raise NgptError(f"{path}: cannot be written as OpenEXR: {_reason(error, name, Path(path))}") from error
    return Path(path)


def _reason(error: Exception, name: str, path: Path) -> str:
    """The first line of OpenEXR's error; the ``name`` that OpenEXR was given is replaced by the file's own name."""
    return (str(error).splitlines() or [type(error).__name__])[0].replace(name, path.name)


def _numbered(file: BinaryIO) -> str:
    """A name for an open file. Its own name may belong to another file by now, or OpenEXR may fail to encode it."""
    return str(_NUMBERS / str(file.fileno())) if _NUMBERS.is_dir() else str(file.name)


@contextlib.contextmanager
def _name_to_write(path: Path) -> Iterator[str]:
    """Yields ``_numbered`` of a file to write. Without such names, yields the file's own name, and it stays closed."""
    if _NUMBERS.is_dir():
        with open(path, "r+b") as file:
            yield _numbered(file)
    else:
        yield str(path)


def _state(file: BinaryIO) -> tuple[int, int]:
    """The size of a file and the time of its last change."""
    status = os.fstat(file.fileno())
    return status.st_size, status.st_mtime_ns


def _decode(file: BinaryIO, path: Path, headers: list[PartHeader]) -> list[Any]:
    """The parts as OpenEXR reads them. Raises NgptError unless they have the channels and sizes in ``headers``."""
    name = _numbered(file)
    # OpenEXR skips a part whose pixels it cannot read, and only prints a warning to Python's stdout.
    printed = io.StringIO()
    try:
        with _one_at_a_time, contextlib.redirect_stdout(printed), _without_native_stderr(), _all_cores():
            parts = OpenEXR.File(name, separate_channels=True).parts
    except MemoryError as error:
        size = sum(header.bytes for header in headers) / 2**20
        raise NgptError(f"{path}: out of memory: its channels take {size:.0f} MiB; free some, or cut it up") from error
    except Exception as error:
        reason = _reason(error, name, path)
        raise NgptError(f"{path}: cannot be read ({reason}); it may be damaged: render or copy it again") from error
    # If OpenEXR reads other sizes than ``ngpt.io.header``, the limits were not checked for what OpenEXR reads.
    expected = [({*header.channels}, {header.size[::-1]}) for header in headers]
    got = [({*part.channels}, {channel.pixels.shape for channel in part.channels.values()}) for part in parts]
    if got != expected:
        warning = printed.getvalue().partition("Warning: ")[2].replace(name, path.name).splitlines()
        reason = f" ({warning[0]})" if warning else ""
        raise NgptError(f"{path}: damaged or incomplete{reason}; render or copy it again")
    return parts


@contextlib.contextmanager
def _without_native_stderr() -> Iterator[None]:
    """Hides text that OpenEXR's C core writes to file descriptor 2, since an exception has the same text."""
    try:
        kept = os.dup(2)
    except OSError:  # the process has no stderr
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)


@contextlib.contextmanager
def _all_cores() -> Iterator[None]:
    """Lets OpenEXR use all cores in the block, which is not its default. Its threads end with the block.

    If they did not end, a process that is forked later would wait for them forever. If address space is short, no
    threads are made. If the program has set a number of threads, it is not changed.
    """
    short = free_address_space() < processors() * _THREAD
    if short or OpenEXR.global_thread_count():
        yield
        return
    OpenEXR.set_global_thread_count(processors())
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(0)


def _writable(part: ExrPart, path: str) -> tuple[dict[str, Any], dict[str, Any], str]:
    """The arguments of OpenEXR.Part, header, channels and name, for a part that is written unchanged."""
    header = {}
    for name, value in part.header.items():
        # OpenEXR makes `channels` itself, trusts a `chunkCount` even if it is outdated, and cannot write empty lists.
        if name in ("channels", "chunkCount") or (isinstance(value, list) and not value):
            continue
        header[name] = _attribute(name, value, path)
    if header.get("compression") in _LOSSY:
        header["compression"] = OpenEXR.ZIP_COMPRESSION
    if "tiles" in header:
        # The writer would leave the smaller levels of a mipmap out, which makes the file unreadable.
        tiles = OpenEXR.TileDescription()
        tiles.xSize, tiles.ySize = header["tiles"].xSize, header["tiles"].ySize
        header["tiles"] = tiles
    linear = {channel.name: channel.pLinear for channel in part.header.get("channels", ())}
    channels = {}
    for name, pixels in part.channels.items():
        dtype = pixels.dtype.newbyteorder("=")
        if dtype not in _PIXEL_TYPES or pixels.ndim != 2:
            raise NgptError(
                f"{path}: channel '{name}' is {pixels.dtype} {pixels.shape}; "
                "OpenEXR stores (height, width) arrays of float16, float32 or uint32"
            )
        # OpenEXR ignores strides and byte order: it would write garbage.
        channels[name] = OpenEXR.Channel(np.ascontiguousarray(pixels, dtype), 1, 1, bool(linear.get(name, False)))
    return header, channels, part.name


def _attribute(name: str, value: Any, path: str) -> Any:
    """The ``value`` in a form that OpenEXR stores unchanged. OpenEXR wraps, drops or transposes others silently."""
    value = _plain(value)
    if not _fits(value):
        raise NgptError(
            f"{path}: attribute '{name}' = {' '.join(str(value).split())} ({type(value).__name__}) "
            "does not fit an OpenEXR header; store it as a string"
        )
    return value


def _plain(value: Any) -> Any:
    """The value, with NumPy's scalars as Python's, and with contiguous arrays."""
    if isinstance(value, tuple | list):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, np.generic):
        return value.item()
    return np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value


def _fits(value: Any) -> bool:
    """Whether OpenEXR can store ``value``, except for rounding to 32-bit float."""
    match value:
        case int():
            return -(2**31) <= value < 2**31
        case float():
            return not math.isfinite(value) or abs(value) <= _FLOAT_MAX
        case Fraction():
            return _fits(value.numerator) and _fits(value.denominator)
        case tuple():
            return all(map(_fits, value))
        case list():
            texts = all(isinstance(item, str) for item in value)
            return texts or all(isinstance(item, float) and _fits(item) for item in value)
        case np.ndarray():
            floating = value.dtype in (np.float32, np.float64)
            vector = value.shape in ((2,), (3,)) and (floating or value.dtype == np.int32)
            matrix = value.shape in ((3, 3), (4, 4)) and floating
            return vector or matrix or (value.shape == (1,) and value.dtype == np.float64)
    return isinstance(value, _ATTRIBUTE_TYPES)
