"""Reads the log of a training run: one line of JSON for each entry."""

from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.reading import read_text
from ngpt.system.records import check, parse_json

LOG = "log.jsonl"


def entries_of(path: Path) -> list[dict[str, float]]:
    """The entries of a log. An incomplete last line is left out. Raises NgptError for other lines that are invalid."""
    lines = read_text(path).splitlines()
    entries = []
    for number, line in enumerate(lines, 1):
        where = f"{path}: line {number}"
        try:
            entry = parse_json(line, where)
        except NgptError:
            if number == len(lines):
                break
            raise
        check(entry, {"step": int}, where)
        check(entry, {str: (int, float)}, where)
        entries.append(entry)
    return entries
