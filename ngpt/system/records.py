"""Reads JSON and TOML, and checks the types of their values."""

import json
import tomllib
from collections.abc import Callable
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from ngpt.errors import NgptError, did_you_mean
from ngpt.system.reading import read_text

T = TypeVar("T")

# The shape of a value: a type; a tuple of allowed types; [shape], a list of such values; {name: shape}, a table with at
# least these entries; {str: shape}, a table with any names. Whole numbers have 64 bits.
Shape = type | tuple[type, ...] | list["Shape"] | dict["str | type[str]", "Shape"]


def read_toml(path: str | Path) -> dict[str, Any]:
    """The contents of a TOML file. Raises NgptError if it cannot be read or is not TOML."""
    return _call(tomllib.loads, read_text(path), str(path))


def read_json(path: str | Path) -> Any:
    """The contents of a JSON file. Raises NgptError if it cannot be read or is not JSON."""
    return _call(json.loads, read_text(path), str(path))


def parse_json(text: str, where: str) -> Any:
    """The value of a text in JSON. Raises NgptError, whose message begins with ``where``, if it is not JSON."""
    return _call(json.loads, text, where)


def _call(parser: Callable[[str], Any], text: str, where: str) -> Any:
    try:
        return parser(text)
    except RecursionError:
        raise NgptError(f"{where}: cannot be read: its brackets are nested too deeply") from None
    except ValueError as error:
        raise NgptError(f"{where}: cannot be read: {error}") from error


def check(value: Any, shape: Shape, where: str) -> None:
    """Raises NgptError unless ``value`` has this shape. The message begins with ``where`` and the entry."""
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
        # In Python, True counts as a number.
        right = isinstance(value, kinds) and (not isinstance(value, bool) or bool in kinds)
        in_range = not isinstance(value, int) or abs(value) < 2**63
        _demand(right and in_range, value, " or ".join(kind.__name__ for kind in kinds), where)


def _demand(condition: bool, value: Any, wanted: str, where: str) -> None:
    if not condition:
        raise NgptError(f"{where} is {_shown(value)}; it must be {wanted}")


def _shown(value: Any) -> str:
    """The beginning of the value's ``repr``, for messages."""
    try:
        return repr(value)[:60]
    except ValueError:  # Python raises it for whole numbers of more than 4300 digits
        return "a number of thousands of digits"


def from_table(kind: type[T], values: Any, where: str) -> T:
    """Makes the dataclass ``kind`` from a table of settings, whose values must have the annotated types.

    Lists become tuples, and tables become dataclasses, as annotated: ``tuple[int, ...]``, ``tuple[Files, ...]``. A
    whole number also counts as a number. Raises NgptError, whose message begins with ``where``, for settings that are
    unknown, missing, of another type, or refused by ``kind`` with an NgptError.
    """
    if not isinstance(values, dict):
        raise NgptError(f"{where} = {_shown(values)}: must be a table")
    known: dict[str, Field] = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    hints, read = get_type_hints(kind), {}
    for name, value in values.items():
        if name not in known:
            raise NgptError(f"{where}: unknown key '{name}'; {did_you_mean(name, known)}there are: {', '.join(known)}")
        try:
            read[name] = _converted(value, hints[name], f"{where}: [{name}]")
        except _OtherType:
            wanted = f"{described(hints[name])}{_example(known[name].default)}"
            raise NgptError(f"{where}: {name} = {_shown(value)}: must be {wanted}") from None
    for name, field in known.items():
        if name not in read and field.default is MISSING and field.default_factory is MISSING:
            raise NgptError(f"{where}: lacks '{name}'")
    try:
        return kind(**read)
    except NgptError as error:
        raise NgptError(f"{where}: {error}") from error


class _OtherType(Exception):
    """A value does not have its annotated type."""


def _converted(value: Any, hint: Any, where: str) -> Any:
    """The ``value`` as the annotated type. Raises ``_OtherType`` if it has another type."""
    kinds = get_args(hint)
    if get_origin(hint) is UnionType:  # a table that may be left out
        return _converted(value, kinds[0], where)
    if is_dataclass(hint):
        return from_table(hint, value, where)  # type: ignore[arg-type]
    if hint is Any:
        return value
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        if kinds[-1] is ...:
            kinds = kinds[:1] * len(value)
        if len(value) != len(kinds):
            raise _OtherType
        return tuple(_converted(v, kind, f"{where}[{i}]") for i, (v, kind) in enumerate(zip(value, kinds, strict=True)))
    if get_origin(hint) is dict and isinstance(value, dict):
        return {name: _converted(item, kinds[1], f"{where}: [{name}]") for name, item in value.items()}
    # In Python, True counts as a number.
    if isinstance(value, bool) and hint is not bool:
        raise _OtherType
    right = (int, float) if hint is float else get_origin(hint) or hint
    if not isinstance(value, right) or (isinstance(value, int) and abs(value) >= 2**63):
        raise _OtherType
    return value


_NAMES = {int: "whole number", float: "number", str: "string", dict: "table", list: "list"}


def described(hint: Any, many: bool = False) -> str:
    """An annotated type in words, "a list of strings"; with ``many`` in the plural, "lists of strings"."""
    kind, kinds = get_origin(hint) or hint, get_args(hint)
    if kind is bool:
        return "true or false"
    name = {tuple: "list"}.get(kind) or _NAMES.get(kind, "table")
    text = f"{name}s" if many else f"a {name}"
    if kind is tuple:
        return f"{text} of {'' if kinds[-1] is ... else f'{len(kinds)} '}{described(kinds[0], many=True)}"
    return f"{text} of {described(kinds[1], many=True)}" if kind is dict and kinds and kinds[1] is not Any else text


def _example(default: Any) -> str:
    """The default as an example for messages; "" if there is none or it is empty."""
    if default is MISSING or not default:
        return ""
    return f", like {list(default) if isinstance(default, tuple) else repr(default)}"
