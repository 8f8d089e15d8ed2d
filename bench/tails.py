"""Seconds and errors with shared tails (tails=shared) relative to whole paths (tails=paths).

    python -m bench.tails kitchen/scene.xml bedroom/scene.xml --references FOLDER --groups rooms=kitchen,bedroom

Samplers are `primal`, `gpt`, and `mitsuba`: `primal` with Mitsuba's own points and lamps and whole paths. METHODS has
the methods of each. A cell has, for each method:

    seconds    processor seconds of the render, and of the reconstruction, after a warm-up; "whole" is their sum
    error      relMSE by two halves of a reference, without the worst 0.1 % of the pixels
    steady     the same error relative to the denoised reference (``bench.judging.Judge.steady``). Most pixels of a
               noisy reference are too dark, so ``error`` rewards images that are too dark
    FLIP       relative to the mean of the halves
    blocks     the root of the relMSE of means over 8x8 pixels; None if it is too small for the halves to measure
    energy     the mean of the image over the mean of the reference

Cells of the sampler that `ngpt render` takes by default also have ``auto``, the method that it takes by default.

``bench.judging`` opens scenes and makes references. An error with shared tails is divided by the error of the same
sampler and method with whole paths, after the same samples and after the same whole time. ``bench.curves`` explains the
marks, and ``bench.worth`` explains W, C and W/C of gradients. Cells in the file are not measured again. Values are
medians over seeds; means over scenes are geometric.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import ngpt
from bench.common import blocks, digits, renderer, table
from bench.curves import Ratio, error_at, joined, marked, over, over_least
from bench.judging import RIVAL, WARM_SPP, Cells, Judge, command, open_judged, parsed, timed
from bench.worth import worth_tables
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import choose

RAW = "raw"
SECONDS = (5, 10, 20, 40)
METHODS = {
    "primal": [RAW, "oidn", "ngpt-primal"],
    "gpt": ["wcv", "ngpt-fast", "ngpt-combine", "oidn"],
    "mitsuba": ["oidn"],
}
TAILS = ("paths", "shared")
VALUES = ("error", "steady", "FLIP", "blocks", "energy")
ERRORS = VALUES[:-1]
RATIOS = ("seconds", *(f"{name}, {at}" for at in ("samples", "time") for name in ERRORS))
CELL = ("scene", "size", "sampler", "tails", "spp", "seed")
PIPELINE = ["scene", "size", "sampler", "method"]
# Our pipelines, as columns of an evaluation. `gpt` with `oidn` is left out, because `oidn` reads no gradients.
PIPELINES = {
    f"{sampler}+{method}": {"sampler": sampler, "stack": "gradients" if sampler == "gpt" else "primal"}
    for sampler in ("primal", "gpt")
    for method in METHODS[sampler]
    if (sampler, method) != ("gpt", "oidn") and method != RAW
}
MITSUBA = "mitsuba+oidn"


def main() -> None:
    parser = command(__doc__, "tails", "640x360", (4, 16, 64))
    parser.add_argument("--tails", nargs="+", default=list(TAILS), choices=list(TAILS))
    parser.add_argument("--samplers", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument(
        "--groups", nargs="*", default=[], metavar="NAME=SCENE,...", help="means are taken over these scenes"
    )
    args = parsed(parser)
    cells = Cells(args.output, "tails", CELL)
    cells.measure(args.scenes, lambda scene, known: measured(scene, args, known))
    groups = dict(text.split("=", 1) for text in args.groups)
    show(cells, {name: members.split(",") for name, members in groups.items()})


def measured(scene: str, args: argparse.Namespace, known: set[tuple]) -> Iterator[dict[str, Any]]:
    """Yields the cells of a scene that are not ``known``."""
    _, render_stack = renderer()
    from data_gen.choosing.plans import plan_sampler
    from data_gen.request import RenderRequest

    scene, loaded, judge = open_judged(scene, args.size, args.references, args.reference_spp)
    chosen = plan_sampler(loaded, RenderRequest(loaded, min(args.spp)))
    for sampler in args.samplers:
        warm: set[str] = set()
        name, options = ("primal", RIVAL) if sampler == "mitsuba" else (sampler, {})
        for spp in args.spp:
            for seed in args.seeds:
                for tails in args.tails if sampler != "mitsuba" else ["paths"]:
                    values = (scene, args.size, sampler, tails, spp, seed)
                    if values in known:
                        continue
                    if tails not in warm:
                        stack = render_stack(loaded, WARM_SPP, 0, name, tails=tails, **options)
                        for method in METHODS[sampler]:
                            image_of(stack, method)
                        warm.add(tails)
                    load = os.getloadavg()[0]
                    stack, seconds = timed(partial(render_stack, loaded, spp, seed, name, tails=tails, **options))
                    cell = dict(zip(CELL, values, strict=True)) | {"seconds": seconds, "load average": load}
                    cell["options"] = stack.attributes.get("ngpt:samplerOptions", "")
                    if sampler == chosen.sampler and tails == "shared":
                        cell["auto"] = chosen.method or choose(stack)
                    yield cell | {"methods": {method: judged(stack, method, judge) for method in METHODS[sampler]}}


def image_of(stack: ngpt.GradientStack, method: str) -> np.ndarray:
    return stack["primal"] if method == RAW else ngpt.reconstruct(stack, method).image


def judged(stack: ngpt.GradientStack, method: str, judge: Judge) -> dict[str, float | None]:
    """Seconds of the reconstruction, and ``VALUES``. The raw primal has no FLIP."""
    image, seconds = timed(lambda: image_of(stack, method))
    found = judge.scores(image, "relMSE trimmed", *(["FLIP"] if method != RAW else []))
    coarse = relmse_trimmed(*(blocks(each.astype(np.float64)) for each in (image, *judge.reference.images)))
    return {
        "seconds": seconds if method != RAW else 0.0,
        "error": found["relMSE trimmed"],
        "steady": judge.steady(image),
        "FLIP": found.get("FLIP"),
        "blocks": coarse**0.5 if coarse > 0 else None,
        "energy": judge.light(image),
    }


def medians(cells: list[dict]) -> dict[tuple, pd.DataFrame]:
    """Pipeline -> medians over seeds: columns ``render``, ``whole`` and ``VALUES``, indexed by samples and tails."""
    lines = [
        {name: cell[name] for name in CELL}
        | {"method": method, "render": cell["seconds"], "whole": cell["seconds"] + values["seconds"]}
        | {name: values.get(name) for name in VALUES}
        for cell in cells
        for method, values in cell["methods"].items()
    ]
    frame = pd.DataFrame(lines).astype(dict.fromkeys(VALUES, float))
    return {
        key: here.groupby(["spp", "tails"])[["render", "whole", *VALUES]].median()
        for key, here in frame.groupby(PIPELINE, sort=False)
    }


def with_tails(here: pd.DataFrame, tails: str) -> pd.DataFrame:
    """The rows with these tails, indexed by samples."""
    return here[here.index.get_level_values("tails") == tails].droplevel("tails")


def points(here: pd.DataFrame, value: str) -> list[tuple[float, float]]:
    known = here[here[value] > 0]
    return list(zip(known["whole"], known[value], strict=True))


def ratios(here: pd.DataFrame, spp: int) -> dict[str, Ratio]:
    """Values with shared tails over values with whole paths: ``RATIOS``, with marks; {} if either is missing."""
    if any((spp, tails) not in here.index for tails in TAILS):
        return {}
    paths, shared = (here.loc[spp, tails] for tails in TAILS)
    found = {"seconds": (shared["whole"] / paths["whole"], "")}
    for name in ERRORS:
        if shared[name] > 0 and paths[name] > 0:
            found[f"{name}, samples"] = shared[name] / paths[name], ""
            if time := over_least(shared[name], shared["whole"], [points(with_tails(here, "paths"), name)]):
                found[f"{name}, time"] = time
    return found


def show(cells: list[dict], groups: dict[str, list[str]]) -> None:
    found: dict[tuple, dict[str, dict[str, Ratio]]] = {}
    lines = []
    for (scene, size, sampler, method), here in medians(cells).items():
        for spp in here.index.unique("spp"):
            found_here = ratios(here, spp)
            found.setdefault((size, sampler, method, str(spp)), {})[scene] = found_here
            pair = here.loc[spp].reindex(TAILS)
            values = [" / ".join(map(digits, pair[name])) for name in ("render", "whole", *VALUES)]
            cells_of_ratios = (marked(found_here.get(r)) for r in RATIOS)
            lines.append([f"{scene} {size}", sampler, method, str(spp), *values, *cells_of_ratios])
    print("\ntails=paths / tails=shared, and the second over the first; seconds of processors")
    table(["scene", "sampler", "method", "spp", "render s", "whole s", *VALUES, *RATIOS], lines)
    lines = []
    for name, members in groups.items():
        for (size, *place), by_scene in found.items():
            here = [each for scene, each in by_scene.items() if scene in members and each]
            if here:
                means = [over([each.get(key) for each in here]) for key in RATIOS]
                lines.append([f"{name} ({len(here)}) {size}", *place, *means])
    print("\ngeometric means over scenes")
    table(["scenes", "sampler", "method", "spp", *RATIOS], lines)
    for tails in TAILS:
        print(f"\ngradients, tails={tails}")
        for title, (head, *lines) in worth_tables(evaluated(cells, tails, groups)).items():
            print(f"\n{title}")
            table(head, lines)
    for tails in sorted({cell["tails"] for cell in cells}):
        print(f"\npipelines after equal whole time, tails={tails}: error and FLIP relative to `primal` with `oidn`")
        table(["scenes", "processor s", *PIPELINES, MITSUBA], against_oidn(cells, tails, groups))
        if tails == "shared":
            print("\nwhat `ngpt render` and `ngpt denoise` take by default, relative to the best of our pipelines")
            table(["scenes", *(f"{seconds} s" for seconds in SECONDS)], default_over_best(cells, tails, groups))
    loads = [cell["load average"] for cell in cells]
    print(f"\nload average {min(loads):.1f} to {max(loads):.1f}")


def curves_of(cells: list[dict], tails: str) -> dict[str, dict[str, pd.DataFrame]]:
    """Scene -> pipeline -> medians indexed by samples, for all ``PIPELINES`` and for ``MITSUBA``."""
    curves: dict[str, dict[str, pd.DataFrame]] = {}
    for (scene, _, sampler, method), here in medians(cells).items():
        if (name := f"{sampler}+{method}") in (*PIPELINES, MITSUBA):
            curves.setdefault(scene, {})[name] = with_tails(here, "paths" if name == MITSUBA else tails)
    return curves


def groups_of(curves: dict[str, Any], groups: dict[str, list[str]]) -> list[tuple[str, list[str]]]:
    """(name, measured scenes): each scene by itself, then each group that has any."""
    known = [(name, [scene for scene in members if scene in curves]) for name, members in groups.items()]
    return [*((scene, [scene]) for scene in curves), *((name, members) for name, members in known if members)]


def both(scenes: list[str], ratio: Callable[[str, str], Ratio | None]) -> str:
    """The means over scenes of ``ratio(scene, value)``, for the error and for FLIP, as text."""
    return ", ".join(over([ratio(scene, value) for scene in scenes]) for value in ("error", "FLIP"))


def against_oidn(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> list[list[str]]:
    """Rows for each scene and group, and each of ``SECONDS``: pipelines over `primal` with `oidn`."""
    curves = curves_of(cells, tails)

    def ratio(name: str, seconds: float, scene: str, value: str) -> Ratio | None:
        here = [curves[scene].get(each) for each in (name, "primal+oidn")]
        a, b = (None if each is None else error_at(seconds, points(each, value)) for each in here)
        return (a[0] / b[0], joined((a[1], b[1]))) if a and b else None

    return [
        [label, str(seconds), *(both(here, partial(ratio, name, seconds)) for name in (*PIPELINES, MITSUBA))]
        for label, here in groups_of(curves, groups)
        for seconds in SECONDS
    ]


def default_over_best(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> list[list[str]]:
    """Rows for each scene and group: the default pipeline over the best of ``PIPELINES`` at each of ``SECONDS``."""
    curves = curves_of(cells, tails)
    taken = {cell["scene"]: f"{cell['sampler']}+{cell['auto']}" for cell in cells if "auto" in cell}

    def ratio(seconds: float, scene: str, value: str) -> Ratio | None:
        ours = {name: error_at(seconds, points(here, value)) for name, here in curves[scene].items() if name != MITSUBA}
        known = {name: found for name, found in ours.items() if found}
        if taken.get(scene) not in known:
            return None
        mine, best = known[taken[scene]], min(known.values())
        return mine[0] / best[0], joined((mine[1], best[1]))

    return [
        [label, *(both(here, partial(ratio, seconds)) for seconds in SECONDS)]
        for label, here in groups_of(curves, groups)
    ]


def evaluated(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> dict[str, Any]:
    """The cells with these ``tails``, with those entries of a results.json that ``bench.worth`` reads."""
    summary, renders = [], []
    for (scene, _, sampler, method), here in medians(cells).items():
        if (name := f"{sampler}+{method}") in PIPELINES:
            for spp, line in with_tails(here, tails).iterrows():
                row = {"scene": scene, "method": name, "spp": spp}
                summary.append(row | {"error": line["error"], "seconds": {"total": line["whole"]}})
                renders.append(row | {"absent": None, "spp used": spp, "seconds": {"render": line["render"]}})
    settings = {"spp": sorted({cell["spp"] for cell in cells}), "groups": groups}
    scenes = list(dict.fromkeys(row["scene"] for row in summary))
    return {"scenes": scenes, "summary": summary, "cells": renders, "methods": PIPELINES, "settings": settings}


if __name__ == "__main__":
    main()
