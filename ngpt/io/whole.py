"""Whether a file is a complete OpenEXR image, without decoding it: interrupted copies and full disks leave incomplete
files.

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
    """Whether ``path`` exists and is complete: its headers make sense, and all chunks in its tables end within the
    file.

    Some kilobytes are read. Damage within a chunk is not seen. A folder or a device counts as finished, because it must
    not be replaced.
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
    """Where the last chunk ends in an open file whose headers have been read; raises struct.error if the file ends
    earlier.

    Each chunk begins with the number of its part (in files of several), its place, and the size of what follows.
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
