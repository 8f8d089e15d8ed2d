"""The log of a training run, beside its weights: one line of JSON for each entry."""

from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.reading import read_text
from ngpt.system.records import check, parse_json

LOG = "log.jsonl"


def entries_of(path: Path) -> list[dict[str, float]]:
    """The entries of a log. A last line that is still being written is left out."""
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
