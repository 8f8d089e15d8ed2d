"""Frames on a command line: which ones, and text that changes from frame to frame."""

import argparse
import ast
import math
import operator
import re
from collections.abc import Callable
from pathlib import Path

from ngpt.errors import NgptError

# {frame}, {frame:04d}, {10 + frame * 3:.2f}
_FIELD = re.compile(r"\{([^{}:]+)(?::([^{}]*))?\}")
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
# More than anyone renders; a typing error must not fill the memory.
_MOST = 1_000_000


def frames(text: str) -> list[int]:
    """``0:120`` (120 is not in it), ``0:120:2``, ``7``, or several of them with commas between; in order."""
    numbers: dict[int, None] = {}
    for part in text.split(","):
        try:
            values = [int(number) for number in part.split(":")]
        except ValueError:
            values = []
        if len(values) not in (1, 2, 3):
            raise argparse.ArgumentTypeError(f"'{part}' is no frame; write 7, 0:120 (120 is not in it) or 0:120:2")
        found = range(values[0], values[0] + 1) if len(values) == 1 else range(*values) if 0 not in values[2:] else ()
        if not found or len(found) > _MOST:
            raise argparse.ArgumentTypeError(f"'{part}' are {len(found)} frames; write START:END or START:END:STEP")
        numbers.update(dict.fromkeys(found))
    return list(numbers)


def varies(text: str) -> bool:
    """Whether a text is another one in another frame."""
    return any("frame" in field for field, _ in _FIELD.findall(text))


def filled(text: str, frame: int) -> str:
    """The text with its fields replaced: ``{frame}``, ``{frame:04d}``, ``{10 + frame * 3:.2f}``.

    A field is a number, ``frame``, ``pi``, + - * / // %, brackets, sin, cos, min, max, and how to write it, as in
    Python. Raises NgptError for anything else.
    """

    def value(match: re.Match) -> str:
        field, form = match.groups()
        try:
            number = _value(ast.parse(field.strip(), mode="eval").body, frame)
            if form and form[-1] in "dxX" and number == int(number):
                number = int(number)
            return format(number, form or "")
        except NgptError as error:
            raise NgptError(f"'{text}': {error}") from error
        except (SyntaxError, ValueError, ArithmeticError, TypeError) as error:
            raise NgptError(f"'{text}': {match[0]} cannot be computed for frame {frame}: {error}") from error

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
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS:
        return _FUNCTIONS[node.func.id](*(_value(argument, frame) for argument in node.args))
    raise NgptError(
        f"'{ast.unparse(node)}' is not known in {{}}; known are numbers, frame, pi, + - * / // %, brackets, "
        f"{', '.join(_FUNCTIONS)}"
    )


def targets(output: str | None, scene: str, numbers: list[int]) -> dict[int, Path]:
    """Frame -> file. ``output`` is a pattern (``shot.{frame:04d}.exr``), or a folder, which is made if it is not there.

    Raises NgptError for a name that is one file for several frames.
    """
    stem = re.sub(r"[._-]*\{[^{}]*\}", "", Path(scene).stem) or "frame"
    pattern = output if output is not None else f"{stem}.{{frame:04d}}.exr"
    if not varies(pattern):
        folder = Path(pattern)
        if folder.suffix.lower() == ".exr" and not folder.is_dir():
            if len(numbers) > 1:
                named = f"{folder.with_suffix('')}.{{frame:04d}}.exr"
                raise NgptError(f"{folder}: is one file for {len(numbers)} frames; write -o '{named}', or a folder")
            return {numbers[0]: folder}
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise NgptError(f"{folder}: cannot be made: {error.strerror}") from error
        pattern = str(folder / f"{stem}.{{frame:04d}}.exr")
    found = {number: Path(filled(pattern, number)) for number in numbers}
    seen: dict[Path, int] = {}
    for number, path in found.items():
        if path.suffix.lower() != ".exr":
            raise NgptError(f"{path}: ngpt writes OpenEXR; let the name end in .exr")
        if (other := seen.setdefault(path, number)) != number:
            raise NgptError(f"{path}: would be frame {other} and frame {number}; write {{frame:04d}} in the name")
    return found
