"""Runs an evaluation, cell by cell (scenes x samples x methods x seeds), and writes the folder of results."""

import gc
import os
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.evaluation.cells import PACKAGES, Scorer, absence
from ngpt.evaluation.config import Column, EvaluationConfig, file_part
from ngpt.evaluation.references import HALVES, Reference
from ngpt.evaluation.renders import KINDS, Render
from ngpt.evaluation.results import write_results
from ngpt.evaluation.stacks import USUAL, SceneStacks
from ngpt.image.display import auto_exposure
from ngpt.io.exr import write
from ngpt.measure.metrics import METRICS
from ngpt.methods import METHODS
from ngpt.renderer import Renderer
from ngpt.report.evaluation import FORMAT
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.files import exclusive, make_folder
from ngpt.system.machine import metadata


def evaluate(
    config: EvaluationConfig, out: Path, console: Console, command: str, renderer: Renderer, cache: Path | None = None
) -> dict[str, Any]:
    """Fills the folder ``out``, and returns the contents of its results.json. ``renderer`` renders missing stacks.

    Cells in the cache (by default ``out``/cache) are not computed again, so an interrupted run can be continued. If a
    scene or a method lacks something, its rows say what. Raises NgptError for scenes, references and samplers that do
    not exist, before anything is rendered.
    """
    scenes = config.scene_files()
    check_named(config, scenes, renderer)
    make_folder(out)
    cache = cache or out / "cache"
    columns = config.columns()
    lacks = {column.name: absence(column) for column in columns}
    scorer = Scorer(config, cache / "cells")
    results: dict[str, Any] = {
        "format": FORMAT,
        "title": config.title,
        "command": command,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "metadata": metadata(*PACKAGES),
        "settings": config.to_dict(),
        "metrics": {
            name: {key: getattr(METRICS[name], key) for key in ("formula", "better", "squared")}
            | {"absent": scorer.absent_metrics.get(name)}
            for name in config.metrics
        },
        "primary": config.primary,
        "methods": {
            column.name: {
                "summary": METHODS[column.method].summary if column.method in METHODS else "",
                "method": column.method,
                "family": column.family,
                "stack": column.render.kind,
                "sampler": column.sampler,
                "render": column.render.name,
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
    total = len(scenes) * sum(len(here) for *_, here in config.places())
    with exclusive(out), console.progress("evaluate", "cells") as progress:
        progress(0, total)
        for i, (name, source) in enumerate(scenes.items()):
            done = total * i // len(scenes)

            def advance(n: int, done: int = done) -> None:
                progress(done + n, total)

            try:
                stacks = SceneStacks(name, source, config, cache, renderer, say=console.say)
                _scene(stacks, columns, lacks, scorer, results, out, advance)
            except NgptError as error:
                console.error(f"{name}: {error}")
                results["scenes"].setdefault(name, {"file": source})["absent"] = str(error)
                results["cells"] += [
                    _absent(name, spp, column.name, seed, str(error))
                    for spp, seed, here in config.places()
                    for column in here
                ]
            # Results are written after each scene, so that they can be looked at during a long run.
            write_results(results, out)
            # Kernels contain code for the objects of all scenes in memory, so finished scenes are removed.
            gc.collect()
        progress(total, total)
    return results


def check_named(config: EvaluationConfig, scenes: dict[str, str], renderer: Renderer) -> None:
    """Raises NgptError unless all ``scenes``, their references, and the samplers for every scene exist."""
    for name, source in scenes.items():
        if not os.path.exists(source):
            renderer.scene_code(source)
        named = config.references.get(name, [])
        for file in [named] if isinstance(named, str) else named:
            if not os.path.isfile(file):
                raise NgptError(f"{file}: no such file; evaluation: references.{name} names it")
    if all(os.path.isdir(source) for source in scenes.values()):
        return  # The samplers of finished stacks may have any name.
    for entry in ("clock", "reference_sampler"):
        sampler, _ = config.sampler(getattr(config, entry))
        if sampler != KINDS["gradients"]:
            try:
                renderer.unusual(sampler, {})
            except NgptError as error:
                raise NgptError(f"evaluation: {entry}: {error}") from None


def _scene(
    stacks: SceneStacks,
    columns: list[Column],
    lacks: dict[str, str],
    scorer: Scorer,
    results: dict[str, Any],
    out: Path,
    advance: Callable[[int], None],
) -> None:
    """Adds a scene and its cells to ``results``. Raises NgptError for errors that affect all cells."""
    config, name = stacks.config, stacks.name
    reference = stacks.reference()
    costs = stacks.costs(column.render for column in columns if not lacks[column.name])
    renders = {column.name: stacks.resolve(column.render) for column in columns}
    lacks = {n: lacks[n] or stacks.lacks.get(render.name, "") for n, render in renders.items()}
    pilot = _pilot([render for n, render in renders.items() if not lacks[n]])
    first = stacks.stack(pilot, stacks.samples(pilot, config.spp[0], costs), 0)
    if stacks.given or name in config.references:
        # Stacks that were rendered here are not checked, because fireflies of few samples could look like another
        # exposure.
        reference.check(first)
    entry: dict[str, Any] = {"file": stacks.source, "size": [first.width, first.height], "cost": costs}
    entry["exposure"] = auto_exposure(reference.mean)
    entry["reference"] = _reference_entry(reference, scorer, name, out)
    entry["absent"] = None
    cells: list[dict[str, Any]] = []
    for spp, seed, here in config.places():
        held: dict[str, GradientStack] = {}
        for column in here:
            advance(len(cells))
            if lacks[column.name]:
                cells.append(_absent(name, spp, column.name, seed, lacks[column.name]))
                continue
            render = renders[column.name]
            used = stacks.samples(render, spp, costs)
            load = partial(_held, held, stacks, render, used, seed)
            image = picture_path(name, spp, column.name, seed) if wanted(config.images, seed) else None
            key = stacks.stack_key(render, used, seed)
            cell = scorer.cell(column, load, reference, key, out / image if image else None)
            if cell["absent"]:
                cells.append(_absent(name, spp, column.name, seed, cell["absent"]))
                continue
            cells.append(
                {
                    "scene": name,
                    "spp": spp,
                    "method": column.name,
                    "seed": seed,
                    "spp used": used,
                    "seconds": _seconds(load().number("ngpt:seconds"), cell["reconstruct"], config.time),
                    "metrics": cell["metrics"],
                    "image": image,
                    "absent": None,
                }
            )
    # The cells are added all at once, so that a scene that fails half-way is absent as a whole.
    results["scenes"][name] = entry
    results["cells"] += cells


def _held(
    held: dict[str, GradientStack], stacks: SceneStacks, render: Render, samples: int, seed: int
) -> GradientStack:
    """The stack of a render, which is loaded once for all columns."""
    if render.name not in held:
        held[render.name] = stacks.stack(render, samples, seed)
    return held[render.name]


def _seconds(render: float | None, reconstruct: dict[str, float], clock: str) -> dict[str, float | None]:
    """The seconds of a cell: to render, to reconstruct and in total by the ``clock``; and wall seconds to reconstruct.

    Renders include features, film and recording, but not the compilation of kernels.
    """
    total = None if render is None else render + reconstruct[clock]
    seconds = {"render": render, "reconstruct": reconstruct[clock], "total": total}
    return seconds | {"reconstruct wall": reconstruct["wall"]}


def _pilot(renders: list[Render]) -> Render:
    """The render that shows size and exposure of a scene: the usual one, unless all gradient columns have others."""
    gradients = [render for render in renders if render.kind == USUAL.kind]
    return gradients[0] if gradients and USUAL not in gradients else USUAL


def _reference_entry(reference: Reference, scorer: Scorer, name: str, out: Path) -> dict[str, Any]:
    """The entry of a reference in results.json; also writes its images."""
    images = {"reference.exr": reference.mean}
    if len(reference.images) > 1:
        images |= {f"reference{half}.exr": image for half, image in zip(HALVES, reference.images, strict=True)}
    # Relative paths, so that the folder can be moved.
    paths = [f"images/{name}/{file}" for file in images]
    if kept := wanted(scorer.config.images, 0):
        (out / paths[0]).parent.mkdir(parents=True, exist_ok=True)
        for path, image in zip(paths, images.values(), strict=True):
            write(out / path, image, overwrite=True)
    return {
        "image": paths[0] if kept else None,
        "halves": len(reference.images) == 2,
        "images of halves": paths[1:] if kept else [],
        "spp": reference.total("ngpt:spp"),
        "seconds": reference.total("ngpt:seconds"),
        "noise": reference.noise,
        "doubt": reference.doubt,
        "floors": scorer.floors(reference),
    }


def wanted(images: str, seed: int) -> bool:
    """Whether images of a seed are kept, by the entry ``images`` of the configuration."""
    return images == "all" or (images == "first" and seed == 0)


def picture_path(scene: str, spp: int, method: str, seed: int) -> str:
    """The path of a cell's image, relative to the folder of results. ``method`` is the name of the column."""
    return f"images/{scene}/{spp}-{file_part(method)}{f'-seed{seed}' if seed else ''}.exr"


def _absent(scene: str, spp: int, method: str, seed: int, why: str) -> dict[str, Any]:
    row: dict[str, Any] = {"scene": scene, "spp": spp, "method": method, "seed": seed, "spp used": None}
    return row | {"seconds": None, "metrics": {}, "image": None, "absent": why}
