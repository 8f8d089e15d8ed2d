"""Functions that several benchmarks use: times, versions of packages, tables, cached renders, Mitsuba."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from ngpt.measure.averages import summary
from ngpt.stack import GradientStack
from ngpt.system import machine
from ngpt.system.writing import markdown_table, write_json


def measure(
    calls: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, dict]:
    """Times each call ``repeats`` times, after one call that is not timed.

    The calls take turns, so that other work on the machine affects all of them alike. Returns
    name -> {"median", "low", "high"} in seconds of ``clock``; "low" and "high" are the quartiles.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if repeat:
                seconds[name].append(clock() - start)
    return {name: summary(values) for name, values in seconds.items()}


def metadata(*packages: str) -> dict:
    """The date, the machine, and the versions of NumPy, SciPy and ``packages``."""
    return {"date": datetime.now(UTC).strftime("%Y-%m-%d"), **machine.metadata("numpy", "scipy", *packages)}


def save(path: str | Path, result: dict) -> None:
    """Writes or replaces a JSON file; creates its folder if necessary."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_json(Path(path), result)


def write_page(page: Path, text: str, marks: tuple[str, str]) -> None:
    """Replaces the text between two marks of a page."""
    before, _, rest = page.read_text().partition(marks[0])
    _, _, after = rest.partition(marks[1])
    page.write_text(f"{before}{marks[0]}\n\n{text}\n\n{marks[1]}{after}")


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> None:
    """Prints a table in Markdown."""
    print(*markdown_table(list(head), lines), sep="\n", flush=True)


def digits(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.4g}" if value < 100 else f"{value:.0f}"


def blocks(image: np.ndarray, side: int = 8) -> np.ndarray:
    """Means over blocks of ``side`` x ``side`` pixels of (..., H, W, C); pixels beyond whole blocks are left out."""
    *n, h, w, c = image.shape
    image = image[..., : h // side * side, : w // side * side, :]
    return image.reshape(*n, h // side, side, w // side, side, c).mean(axis=(-4, -2))


def kept(path: Path, make: Callable[[], GradientStack]) -> GradientStack:
    """The stack in a file. If the file does not exist, ``make`` renders the stack, which is then written to it."""
    if not path.exists():
        print(f"rendering {path.name}", flush=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        ngpt.write(path, make())
    return ngpt.read(path)


def renderer(variant: str | None = None) -> tuple[Callable[..., Any], Callable[..., GradientStack]]:
    """``load_scene`` and ``render_stack`` of ``data_gen``. Mitsuba is loaded, and its variant set, only here."""
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(variant or DEFAULT_VARIANT)
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    return load_scene, render_stack
