"""Texts with fields that depend on the number of a frame, see ``filled``."""

import ast
import math
import operator
import re
from collections.abc import Callable

from ngpt.errors import WrongUse

# {frame}, {frame:04d}, {10 + frame * 3:.2f}
_FIELD = re.compile(r"\{([^{}:]+)(?::([^{}]*))?\}")
# Python's format of a number. Its width is limited, since a width of a billion would fill the memory.
_FORM = re.compile(r"(.?[<>=^])?[-+ ]?#?\d{0,2}[,_]?(\.\d{1,2})?[a-zA-Z%]?")
_OPERATORS: dict[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_FUNCTIONS: dict[str, Callable] = {"sin": math.sin, "cos": math.cos, "min": min, "max": max}


def varies(text: str) -> bool:
    """Whether a text depends on the frame."""
    return any("frame" in field for field, _ in _FIELD.findall(text))


def filled(text: str, frame: int) -> str:
    """The text with its fields replaced: ``{frame}``, ``{frame:04d}``, ``{10 + frame * 3:.2f}``.

    A field is an expression of numbers, ``frame``, ``pi``, + - * / // %, brackets, sin, cos, min and max. Python's
    format of the result may follow, with a width and a precision of at most 99. Raises WrongUse for anything else.
    """

    def value(match: re.Match) -> str:
        field, form = match.groups()
        if form and not _FORM.fullmatch(form):
            raise WrongUse(f"'{text}': '{form}' is no way to write frame {frame}; write :04d or :.2f, with 99 at most")
        try:
            number = _value(ast.parse(field.strip(), mode="eval").body, frame)
            number = int(number) if form and form[-1] in "dxX" and number == int(number) else number
            return format(number, form or "")
        except WrongUse as error:
            raise WrongUse(f"'{text}': {error}") from error
        except (SyntaxError, ValueError, ArithmeticError, TypeError) as error:
            raise WrongUse(f"'{text}': {match[0]} cannot be computed for frame {frame}: {error}") from error

    return _FIELD.sub(value, text)


def _value(node: ast.expr, frame: int):
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        return node.value
    if isinstance(node, ast.Name) and node.id in ("frame", "pi"):
        return frame if node.id == "frame" else math.pi
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_value(node.left, frame), _value(node.right, frame))
    if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_value(node.operand, frame))
    if (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and not node.keywords
        and node.func.id in _FUNCTIONS
    ):
        return _FUNCTIONS[node.func.id](*(_value(argument, frame) for argument in node.args))
    raise WrongUse(
        f"'{ast.unparse(node)}' is not known in {{}}; known are numbers, frame, pi, + - * / // %, brackets, "
        f"{', '.join(_FUNCTIONS)}"
    )
