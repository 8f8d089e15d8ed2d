"""Writes files of bytes, text and JSON, complete or not at all; and formats tables as text."""

import csv
import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ngpt.system.files import atomic_output


def write_bytes(path: str | Path, data: bytes, overwrite: bool = True) -> None:
    """Writes ``path``. Raises NgptError if it cannot be written, or if it exists and ``overwrite`` is False."""
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str, overwrite: bool = True) -> None:
    """Writes ``text`` in UTF-8, as ``write_bytes`` does. Its line ends are not changed, on any system."""
    write_bytes(path, text.encode(), overwrite)


def write_json(path: Path, value: Any) -> None:
    """Writes or replaces ``path``. Raises ValueError for NaN and infinity, which JSON does not have."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """The rows as lines of comma-separated values; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def markdown_table(heads: list[str], rows: Iterable[Iterable[str]], left: int = 1) -> list[str]:
    """A table as lines of Markdown. The first ``left`` columns are aligned to the left, the others to the right."""
    rule = "|---" * left + "|--:" * (len(heads) - left) + "|"
    return [f"| {' | '.join(heads)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]
