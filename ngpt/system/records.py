"""Records in JSON and TOML: read, and checked to be of the shape that the code behind relies on."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError

# A type, several of them, [shape]: a list of such, {name: shape}: a table with at least these entries, {str: shape}: a
# table of any names. Whole numbers are those of 64 bits.
Shape = type | tuple[type, ...] | list["Shape"] | dict["str | type[str]", "Shape"]


def read_toml(path: str | Path) -> dict[str, Any]:
    """Raises NgptError for a file that cannot be read or is no TOML."""
    return _parsed(tomllib.loads, path)


def read_json(path: str | Path) -> Any:
    """Raises NgptError for a file that cannot be read or is no JSON."""
    return _parsed(json.loads, path)


def parse_json(text: str, where: str) -> Any:
    """Raises NgptError for what is no JSON; ``where`` begins the message."""
    return _call(json.loads, text, where)


def _parsed(parser: Callable[[str], Any], path: str | Path) -> Any:
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise NgptError(f"{path}: cannot be read: {getattr(error, 'strerror', '') or error}") from error
    return _call(parser, text, str(path))


def _call(parser: Callable[[str], Any], text: str, where: str) -> Any:
    try:
        return parser(text)
    except RecursionError:
        raise NgptError(f"{where}: cannot be read: brackets within brackets within brackets, too many") from None
    except ValueError as error:
        raise NgptError(f"{where}: cannot be read: {error}") from error


def check(value: Any, shape: Shape, where: str) -> None:
    """Raises NgptError, with ``where`` and the place in the record, unless ``value`` is of that shape."""
    if isinstance(shape, list):
        _demand(isinstance(value, list | tuple), value, "a list", where)
        for i, item in enumerate(value):
            check(item, shape[0], f"{where}[{i}]")
    elif isinstance(shape, dict):
        _demand(isinstance(value, dict), value, "a table", where)
        for name in value if str in shape else shape:
            if name not in value:
                raise NgptError(f"{where}: lacks '{name}'")
            check(value[name], shape[str] if str in shape else shape[name], f"{where}: '{name}'")
    else:
        kinds = shape if isinstance(shape, tuple) else (shape,)
        # To Python, true is a number.
        right = isinstance(value, kinds) and (not isinstance(value, bool) or bool in kinds)
        in_range = not isinstance(value, int) or abs(value) < 2**63
        _demand(right and in_range, value, " or ".join(kind.__name__ for kind in kinds), where)


def _demand(condition: bool, value: Any, wanted: str, where: str) -> None:
    if not condition:
        raise NgptError(f"{where} is {repr(value)[:60]}; it must be {wanted}")
