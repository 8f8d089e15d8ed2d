"""Text and JSON files, complete under their names or not there at all."""

import json
from pathlib import Path
from typing import Any

from ngpt.system.files import atomic_output


def write_text(path: Path, text: str) -> None:
    """Writes or replaces ``path``; raises NgptError where that cannot be done."""
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Writes or replaces ``path``; raises ValueError for NaN and infinity, which JSON does not know."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")
