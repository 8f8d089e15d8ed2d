"""Checks whether an OpenEXR file is complete, without decoding it. Interrupted copies and full disks leave fragments.

Layout of the format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import os
import struct
from pathlib import Path
from typing import BinaryIO

from ngpt.errors import NgptError
from ngpt.io.header import PartHeader, read_headers
from ngpt.system.reading import regular_file

_MULTIPART = 0x1000


def finished(path: str | os.PathLike) -> bool:
    """Whether ``path`` exists, its headers make sense, and all its chunks end within the file.

    Only some kilobytes are read, so damage within a chunk is not noticed. A folder or a device counts as finished,
    because it must not be replaced.
    """
    path = Path(path)
    if not path.is_file():
        return path.exists()
    try:
        with regular_file(path) as file:
            return _ends(file, read_headers(file, str(path))) <= os.fstat(file.fileno()).st_size
    except (NgptError, struct.error, OverflowError):
        return False


def _ends(file: BinaryIO, parts: list[PartHeader]) -> int:
    """The end of the last chunk in an open file whose headers have been read, in bytes.

    Each chunk begins with the number of its part (in files of several parts), its place, and its size. Raises
    struct.error if the file ends before the size of a chunk, or if a chunk was not written.
    """
    tables = [struct.unpack(f"<{part.table}Q", file.read(8 * part.table)) for part in parts]
    begin = file.tell()
    file.seek(4)
    several = struct.unpack("<I", file.read(4))[0] & _MULTIPART
    end = 0
    for part, offsets in zip(parts, tables, strict=True):
        # Writers fill the table in last, so an unfinished file has zeros there. Our files are never deep.
        if min(offsets) < begin or part.deep:
            raise struct.error
        size = max(offsets) + (4 if several else 0) + (16 if part.tiled else 4)
        file.seek(size)
        end = max(end, size + 4 + struct.unpack("<I", file.read(4))[0])
    return end
