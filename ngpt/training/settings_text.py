"""Settings as flat dictionaries, and their differences, without PyTorch."""

from typing import Any


def flat(values: dict[str, Any]) -> dict[str, Any]:
    """The settings as one dictionary: "table.key" -> value."""
    found: dict[str, Any] = {}
    for table, value in values.items():
        found |= {f"{table}.{key}": one for key, one in value.items()} if isinstance(value, dict) else {table: value}
    return found


def difference(*several: dict[str, Any]) -> list[str]:
    """The names of the settings that differ between any of several flat dictionaries."""
    names = dict.fromkeys(name for values in several for name in values)
    return [name for name in names if any(v.get(name) != several[0].get(name) for v in several)]
