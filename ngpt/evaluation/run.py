"""The evaluation itself: scenes x samples x methods x seeds, cell by cell, and the folder of results."""

from __future__ import annotations

import math
import os
import platform
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.evaluation.cells import Scorer, absence, versions
from ngpt.evaluation.config import Column, Config
from ngpt.evaluation.gradientmap import write_map
from ngpt.evaluation.results import write_results
from ngpt.evaluation.stacks import SceneStacks, reference_noise
from ngpt.io.exr import write
from ngpt.measure.advice import describe
from ngpt.measure.metrics import FORMULAS, check_size, exposure_mismatch
from ngpt.methods import METHODS
from ngpt.report.display import auto_exposure
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.files import exclusive

# A reconstruction moves the brightness by less; noise of few samples, and fireflies, may reach it.
MOST_STOPS = 1.0


def evaluate(config: Config, out: Path, console: Console, command: str, cache: Path | None = None) -> dict[str, Any]:
    """Fills the folder ``out`` and returns what its results.json holds.

    What is in the cache, ``out``/cache by default, is not computed again: an interrupted run goes on when it is started
    again. Whatever a scene or a method lacks becomes a row that says so.
    """
    out.mkdir(parents=True, exist_ok=True)
    cache = cache or out / "cache"
    scenes = config.scene_files()
    columns = config.columns()
    lacks = {column.name: absence(column) for column in columns}
    scorer = Scorer(config, cache / "cells")
    results: dict[str, Any] = {
        "format": 1,
        "title": config.title,
        "command": command,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "metadata": metadata(),
        "settings": config.to_dict(),
        "metrics": {
            name: {"formula": FORMULAS[name][0], "better": FORMULAS[name][1], "absent": scorer.absent_metrics.get(name)}
            for name in config.metrics
        },
        "primary": config.primary,
        "methods": {
            column.name: {
                "summary": METHODS[column.method].summary if column.method in METHODS else "",
                "method": column.method,
                "stack": column.stack,
                "options": column.options,
                "absent": lacks[column.name] or None,
            }
            for column in columns
        },
        "scenes": {},
        "cells": [],
    }
    for name, lack in {**lacks, **scorer.absent_metrics}.items():
        if lack:
            console.say(f"{name}: absent: {lack}")
    total = len(scenes) * len(config.spp) * config.seeds * len(columns)
    with exclusive(out), console.progress("evaluate", "cells") as progress:
        progress(0, total)
        for i, (name, source) in enumerate(scenes.items()):
            done = total * i // len(scenes)

            def advance(n: int, done: int = done) -> None:
                progress(done + n, total)

            try:
                stacks = SceneStacks(name, source, config, cache, console.say)
                _scene(stacks, columns, lacks, scorer, results, out, advance)
            except NgptError as error:
                console.error(f"{name}: {error}")
                results["scenes"].setdefault(name, {"file": source})["absent"] = str(error)
                results["cells"] += [
                    _absent(name, spp, column.name, seed, str(error))
                    for spp in config.spp
                    for seed in range(config.seeds)
                    for column in columns
                ]
            # After each scene, so that a long run can be looked at.
            write_results(results, out)
        progress(total, total)
    return results


def _scene(
    stacks: SceneStacks,
    columns: list[Column],
    lacks: dict[str, str],
    scorer: Scorer,
    results: dict[str, Any],
    out: Path,
    advance: Callable[[int], None],
) -> None:
    """Adds a scene and its cells to ``results``; raises NgptError for what concerns all of them."""
    config, name = stacks.config, stacks.name
    reference, file = stacks.reference()
    costs = stacks.costs()
    entry: dict[str, Any] = {"file": stacks.source, "size": [reference.width, reference.height], "cost": costs}
    pixels = reference["primal"]
    first = stacks.stack("gradients", stacks.samples("gradients", config.spp[0], costs), 0)
    if stacks.given or name in config.references:
        # Not our own, where fireflies of few samples could pass for another exposure.
        _check_reference(first, reference, file)
    # Relative, so that the folder can be moved.
    picture = out / "images" / name / "reference.exr"
    if wanted(config.images, 0):
        picture.parent.mkdir(parents=True, exist_ok=True)
        write(picture, pixels, overwrite=True)
    entry["exposure"] = auto_exposure(pixels)
    entry["pilot"] = describe(first) if "primal_var" in first else None
    attributes = reference.attributes
    entry["reference"] = {
        "image": f"images/{name}/reference.exr" if wanted(config.images, 0) else None,
        "spp": _number(attributes.get("ngpt:spp")),
        "seconds": _number(attributes.get("ngpt:seconds")),
        "noise": _number(reference_noise(reference)) if "primal_var" in reference else None,
    }
    entry["absent"] = None
    cells: list[dict[str, Any]] = []
    for spp in config.spp:
        for seed in range(config.seeds):
            held: dict[str, GradientStack] = {}
            for column in columns:
                advance(len(cells))
                if lacks[column.name]:
                    cells.append(_absent(name, spp, column.name, seed, lacks[column.name]))
                    continue
                used = stacks.samples(column.stack, spp, costs)

                def load(kind: str = column.stack, n: int = used, s: int = seed, held: dict = held) -> GradientStack:
                    if kind not in held:
                        held[kind] = stacks.stack(kind, n, s)
                    return held[kind]

                image = picture_path(name, spp, column.name, seed) if wanted(config.images, seed) else None
                key = [stacks.stack_key(column.stack, used, seed), _reference_key(file)]
                cell = scorer.cell(column, load, pixels, key, out / image if image else None)
                if cell["absent"]:
                    cells.append(_absent(name, spp, column.name, seed, cell["absent"]))
                    continue
                rendered = _number(load().attributes.get("ngpt:seconds"))
                seconds = {"render": rendered, "reconstruct": cell["reconstruct"], "total": None}
                if rendered is not None:
                    seconds["total"] = rendered + cell["reconstruct"]
                cells.append(
                    {
                        "scene": name,
                        "spp": spp,
                        "method": column.name,
                        "seed": seed,
                        "spp used": used,
                        "seconds": seconds,
                        "metrics": cell["metrics"],
                        "image": image,
                        "absent": None,
                    }
                )
    maps = gradient_map(stacks, costs, out)
    if maps:
        entry["gradients"] = maps
    # All at once: a scene that fails half-way is absent as a whole.
    results["scenes"][name] = entry
    results["cells"] += cells


def gradient_map(stacks: SceneStacks, costs: dict, out: Path) -> str | None:
    """Draws where gradients pay and where they hurt, from the stack of most samples; its path relative to ``out``."""
    spp = max(stacks.config.spp)
    stack = stacks.stack("gradients", stacks.samples("gradients", spp, costs), 0)
    if not all(layer in stack for layer in ("direct", "primal_var", "dx_var", "dy_var")):
        return None
    path = f"plots/gradients-{stacks.name}.png"
    write_map(out / path, stack)
    return path


def wanted(images: str, seed: int) -> bool:
    """Whether the configuration's entry ``images`` has pictures of a seed kept."""
    return images == "all" or (images == "first" and seed == 0)


def picture_path(scene: str, spp: int, method: str, seed: int) -> str:
    """A cell's picture, relative to the folder of results."""
    return f"images/{scene}/{spp}-{method}{f'-seed{seed}' if seed else ''}.exr"


def _check_reference(stack: GradientStack, reference: GradientStack, file: str) -> None:
    """Raises NgptError for a reference that is of something else."""
    try:
        check_size(stack["primal"], reference["primal"])
    except NgptError as error:
        raise NgptError(f"reference {file}: {error}") from error
    stops = exposure_mismatch(reference["primal"], stack["primal"])
    if abs(stops) > MOST_STOPS:
        raise NgptError(
            f"reference {file}: {abs(stops):.1f} stops {'brighter' if stops > 0 else 'darker'} than the renders; "
            "use one of the same scene and exposure"
        )


def _reference_key(file: str) -> list:
    status = os.stat(file)
    return [Path(file).name, status.st_size, status.st_mtime_ns]


def _absent(scene: str, spp: int, method: str, seed: int, why: str) -> dict[str, Any]:
    row: dict[str, Any] = {"scene": scene, "spp": spp, "method": method, "seed": seed, "spp used": None}
    return row | {"seconds": None, "metrics": {}, "image": None, "absent": why}


def _number(value: Any) -> float | None:
    """A header attribute as a number that JSON knows."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def metadata() -> dict[str, Any]:
    """Where and with what the numbers were made."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False, cwd=Path(__file__).parent
    )
    return {
        "versions": versions(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu": _cpu(),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "commit": commit.stdout.strip() or None,
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
