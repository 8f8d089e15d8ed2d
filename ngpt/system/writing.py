"""Files of bytes, text and JSON, complete under their names or not there at all; and tables as text."""

import csv
import io
import json
from collections.abc import Iterable
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


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Comma-separated values, a line for each row; what is None is empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def markdown_table(heads: list[str], rows: Iterable[Iterable[str]], left: int = 1) -> list[str]:
    """Lines of Markdown; the first ``left`` columns are aligned to the left, the others to the right."""
    rule = "|---" * left + "|--:" * (len(heads) - left) + "|"
    return [f"| {' | '.join(heads)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]
