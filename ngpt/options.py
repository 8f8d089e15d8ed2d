"""Options of samplers and methods, which are the same in commands, files and Python."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ngpt.errors import WrongUse, did_you_mean

# The standing of a sampler or method says for whom it is: all users, users with a special need, or researchers.
STANDINGS = ("use", "niche", "study")

Value = bool | int | float | str
_ANY = (-math.inf, math.inf)


@dataclass(frozen=True)
class Option:
    """An option. Values have the type of the ``default``. If that is a text and there is a ``range``, numbers fit too.

    ``meaning``  one line for the user
    ``choices``  the allowed values; () for any
    ``range``    the least and the greatest number that is allowed; ``choices`` outside of the range are allowed too
    """

    default: Value
    meaning: str
    choices: tuple[Value, ...] = ()
    range: tuple[float, float] = _ANY

    def __str__(self) -> str:
        return f"{self.meaning} ({self.allowed}; default {written(self.default)})"

    @property
    def allowed(self) -> str:
        """The allowed values, in words."""
        if isinstance(self.default, bool):
            return "true or false"
        words = ", ".join(written(choice) for choice in self.choices)
        if self.choices and self.range == _ANY:
            return words
        low, high = (f"{bound:g}" for bound in self.range)
        limits = "" if low == "-inf" else f" of {low} or more" if high == "inf" else f" from {low} to {high}"
        kind = {int: "a whole number", float: "a number", str: "a text"}[self._kind] + limits
        return f"{kind}, or {words}" if words else kind

    def check(self, value: Any) -> Value:
        """Converts the ``value``, which may be a text, to the option's type. Raises WrongUse if it is not allowed."""
        if self.choices and (given := self._typed(value, type(self.choices[0]))) in self.choices:
            assert given is not None
            return given
        typed = self._typed(value, self._kind)
        outside = isinstance(typed, int | float) and not self.range[0] <= typed <= self.range[1]
        if typed is None or outside or (self.choices and self.range == _ANY):
            text = value if isinstance(value, str) else written(value)
            meant = did_you_mean(text, map(written, self.choices))
            raise WrongUse(f"'{text}' is not allowed; it takes {self.allowed}{f'; {meant}' if meant else ''}".rstrip())
        return typed

    @property
    def _kind(self) -> type:
        """The type of values that are not among the choices."""
        return float if isinstance(self.default, str) and self.range != _ANY else type(self.default)

    def _typed(self, value: Any, kind: type) -> Value | None:
        """The ``value`` in the type ``kind``; None if it cannot be converted without loss."""
        if kind is str:
            return os.fspath(value) if isinstance(value, str | os.PathLike) else None
        if isinstance(value, str) and kind is bool:
            return {"true": True, "false": False}.get(value.lower())
        # In Python, bool is a kind of int.
        if isinstance(value, bool) or kind is bool:
            return bool(value) if type(value) is kind else None
        try:
            return kind(value) if isinstance(value, str) or kind(value) == value else None
        except (TypeError, ValueError, OverflowError):
            return None


def written(value: Any) -> str:
    """A value of an option as users write it."""
    if isinstance(value, float):
        short = f"{value:g}"
        return short if float(short) == value else repr(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def settings(owner: str, options: Mapping[str, Option], given: Mapping[str, Any]) -> dict[str, Any]:
    """The values of all ``options``: the ``given`` ones, which may be texts, and defaults for all others.

    Raises WrongUse for unknown options and for values that are not allowed; the message names the ``owner``, such as
    "method 'l2'".
    """
    found: dict[str, Any] = {name: option.default for name, option in options.items()}
    for name, value in given.items():
        if name not in options:
            help = did_you_mean(name, options).strip() or f"it has: {', '.join(options) or 'none'}"
            raise WrongUse(f"{owner} has no option '{name}'; {help}")
        try:
            found[name] = options[name].check(value)
        except WrongUse as error:
            raise WrongUse(f"{owner}, option '{name}': {error}") from None
    return found


def unusual(options: Mapping[str, Option], values: Mapping[str, Any]) -> dict[str, Any]:
    """The ``values`` that are not defaults."""
    return {name: value for name, value in values.items() if value != options[name].default}


def as_text(values: Mapping[str, Any]) -> str:
    """The values as text: NAME=VALUE, separated by commas."""
    return ", ".join(f"{name}={written(value)}" for name, value in values.items())
