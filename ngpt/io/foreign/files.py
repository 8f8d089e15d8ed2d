"""Reads files of all known formats as if they were OpenEXR.

Values that are encoded for displays (PNG, JPEG, TIFF of whole numbers) become scene-linear by the sRGB formula. Colours
are multiplied by alpha, and grey becomes R = G = B. The header attribute ``ngpt:from`` names the original format.
"""

import logging
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR

from ngpt.errors import NgptError
from ngpt.io.foreign import jpeg, pfm, png, radiance, tiff
from ngpt.io.foreign.form import Damage, Form, Unread
from ngpt.io.header import PartHeader, check_size, read_headers
from ngpt.io.openexr import ExrImage, ExrPart, read_exr, read_header
from ngpt.system.reading import regular_file
from ngpt.windows import Window

_LOG = logging.getLogger(__name__)

# The header attribute for the original format, and the end of its value if the image was encoded for displays
FROM, ENCODED = "ngpt:from", " of sRGB"
# The first bytes of a file -> its reader
READERS: dict[bytes, Callable[[BinaryIO], Form]] = {
    b"PF": pfm.describe,
    b"Pf": pfm.describe,
    b"#?": radiance.describe,
    png.MAGIC: png.describe,
    **dict.fromkeys(tiff.MAGICS, tiff.describe),
    jpeg.MAGIC: jpeg.describe,
}
# Exceptions that libraries and struct raise for damaged files
_BROKEN = (Damage, struct.error, zlib.error, ValueError, TypeError, LookupError, ArithmeticError, AttributeError)


def read_file(path: str | os.PathLike) -> ExrImage:
    """Reads a file of any known format. Raises NgptError as ``ngpt.io.openexr.read_exr`` does."""
    path = Path(path)
    with regular_file(path) as file:
        reader = _reader(file)
        if reader is not None:
            form = _form(path, file, reader)
            _tell(path, form)
            return ExrImage([_as_part(path, form)])
    return read_exr(path)


def file_headers(file: BinaryIO, path: str) -> list[PartHeader]:
    """The headers of an open file of any known format. Raises NgptError as ``ngpt.io.header.read_headers`` does."""
    reader = _reader(file)
    return [_header(_form(path, file, reader))] if reader else read_headers(file, path)


def first_attributes(path: Path) -> dict[str, Any]:
    """The attributes of the first part of a file, none for formats other than OpenEXR.

    Raises NgptError as ``ngpt.io.openexr.read_header`` does.
    """
    with regular_file(path) as file:
        if _reader(file):
            return {}
    return read_header(path)[0]


def tell_conversion(path: Path) -> None:
    """Logs the conversion of light as ``read_file`` does, for a file that another process has read."""
    with regular_file(path) as file:
        reader = _reader(file)
        if reader is not None:
            _tell(path, _form(path, file, reader))


def _tell(path: Path, form: Form) -> None:
    if form.encoded:
        _LOG.warning("%s: is %s, as displays take it; made scene-linear by the sRGB formula", path, form.kind)


def _reader(file: BinaryIO) -> Callable[[BinaryIO], Form] | None:
    """The reader of the file; None for OpenEXR and unknown formats."""
    start = file.read(8)
    file.seek(0)
    return next((reader for magic, reader in READERS.items() if start.startswith(magic)), None)


def _form(path: str | Path, file: BinaryIO, reader: Callable[[BinaryIO], Form]) -> Form:
    """The description of an image. Raises NgptError if the image is too large, or if the file is damaged."""
    form = _guarded(path, lambda: reader(file))
    width, height = form.size
    if width < 1 or height < 1:
        raise _damaged(path, f"it is {width}x{height} pixels")
    check_size([_header(form)], os.fstat(file.fileno()).st_size, str(path))
    return form


def _header(form: Form) -> PartHeader:
    channels = dict.fromkeys(_names(form), (4, (1, 1)))
    return PartHeader("", "the image", form.size, channels, False, 0, 0, False, form.ratio, {})


def _names(form: Form) -> str:
    return "RGBA" if form.channels in (2, 4) else "RGB"


def _as_part(path: Path, form: Form) -> ExrPart:
    """The decoded image as a part of OpenEXR."""
    stored = _guarded(path, form.decode)
    planes = [stored[..., i] for i in range(form.channels)]
    alpha = planes.pop() if form.channels in (2, 4) else None
    if form.encoded:
        most = np.iinfo(stored.dtype).max
        curve = linear_srgb(np.arange(most + 1) / most).astype(np.float32)
        planes = [curve[plane] for plane in planes]
        alpha = None if alpha is None else (alpha / np.float32(most)).astype(np.float32)
    if alpha is not None and form.straight:
        with np.errstate(over="ignore", invalid="ignore"):
            planes = [plane * alpha for plane in planes]
    colours = [np.ascontiguousarray(plane, np.float32) for plane in planes]
    channels = dict(zip("RGB", colours * (3 // len(colours)), strict=True))
    channels |= {} if alpha is None else {"A": np.ascontiguousarray(alpha, np.float32)}
    window = Window(0, 0, *form.size).box
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "lineOrder": OpenEXR.INCREASING_Y,
        "dataWindow": window,
        "displayWindow": window,
        FROM: f"{form.kind}{ENCODED if form.encoded else ''}",
    }
    return ExrPart("", header, channels)


def linear_srgb(values: np.ndarray) -> np.ndarray:
    """The linear light of display values from 0 to 1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _guarded(path: str | Path, work: Callable):
    """The result of ``work()``. Errors about the file become NgptErrors that name it."""
    try:
        return work()
    except Unread as error:
        raise NgptError(f"{path}: {error}") from None
    except MemoryError as error:
        raise NgptError(f"{path}: out of memory: free some, or cut it up") from error
    except NgptError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise _damaged(path, str(error)) from error  # Pillow's
    except _BROKEN as error:
        raise _damaged(path, str(error) or type(error).__name__) from error
    except SyntaxError as error:  # Pillow's as well
        raise _damaged(path, str(error.msg)) from error
    except Exception as error:  # tifffile's own
        if type(error).__module__.partition(".")[0] in ("tifffile", "PIL", "imagecodecs"):
            raise _damaged(path, str(error)) from error
        raise


def _damaged(path: str | Path, reason: str) -> NgptError:
    return NgptError(f"{path}: damaged or incomplete ({' '.join(reason.split())[:200]}); save or copy it again")
