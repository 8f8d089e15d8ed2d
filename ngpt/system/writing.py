"""Files of bytes, text and JSON, complete under their names or not there at all."""

import json
from pathlib import Path
from typing import Any

from ngpt.system.files import atomic_output


def write_bytes(path: str | Path, data: bytes, overwrite: bool = True) -> None:
    """Writes ``path``; raises NgptError where that cannot be done, or it is there and ``overwrite`` is not given."""
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str, overwrite: bool = True) -> None:
    """As ``write_bytes``, in UTF-8; lines end as they do in ``text``, on all systems."""
    write_bytes(path, text.encode(), overwrite)


def write_json(path: Path, value: Any) -> None:
    """Writes or replaces ``path``; raises ValueError for NaN and infinity, which JSON does not know."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")
