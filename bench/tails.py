"""The value of shared tails: seconds and errors with tails=shared relative to tails=paths.

    python -m bench.tails kitchen/scene.xml bedroom/scene.xml --references FOLDER --groups rooms=kitchen,bedroom

Samplers are `primal`, `gpt`, and `mitsuba`: `primal` with Mitsuba's own points and lamps and whole paths, denoised by
`oidn`. Methods are in METHODS. Each cell has:

    seconds    of processors, of the render and of the reconstruction, both warmed up; whole: both together
    error      relMSE by two halves of a reference, without the worst 0.1 % of the pixels; FLIP is over their mean
    steady     the same error, relative to the denoised reference, which also selects the worst pixels. Most pixels of a
               noisy reference are too dark, so ``error`` rewards images that are too dark
    blocks     root of the same error of means over 8x8 pixels; none if it is too small for the halves to measure
    energy     mean of the image over the mean of the reference
    auto       the method that the stack gets by default, in cells of the sampler that `ngpt render` takes by default

References are NAME-WxH-a.exr and -b.exr of the folder; missing ones are rendered there, without shared tails. A cell
with shared tails is compared at equal whole time: its error is divided by the error of the same sampler and method with
tails=paths. ``bench.curves`` explains the marks. W, C and W/C of gradients are against `primal` with the same tails.
Cells that the file has are not measured again. Values are medians over seeds, means over scenes geometric.
"""

import argparse
import gc
import json
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import blocks, metadata, renderer, save
from bench.curves import error_at, joined
from bench.worth import worth_tables
from ngpt.evaluation.config import scene_name
from ngpt.evaluation.references import HALVES, Reference, read_reference
from ngpt.measure.averages import geometric_mean, median
from ngpt.measure.metrics import EPSILON, relmse_trimmed, scores, squared_error, trimmed_mean
from ngpt.methods import choose

RAW = "raw"
SECONDS = (5, 10, 20, 40)
METHODS = {
    "primal": [RAW, "oidn", "ngpt-primal"],
    "gpt": ["wcv", "ngpt-fast", "ngpt-combine", "oidn"],
    "mitsuba": ["oidn"],
}
# Mitsuba as it is
RIVAL = {"points": "independent", "lamps": "uniform"}
TAILS = ("paths", "shared")
VALUES = ("error", "steady", "FLIP", "blocks", "energy")
ERRORS = VALUES[:-1]
# Far from the seeds of images
REFERENCE_SEED = 1 << 20
# With this number of samples a render reaches its second round, so that all kernels are compiled.
WARM_SPP = 9
CELL = ("scene", "size", "sampler", "tails", "spp", "seed")


def add_references(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--references", type=Path, metavar="FOLDER")
    parser.add_argument("--reference-spp", type=int, default=256, help="of each half that is made")


def check_references(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    if args.scenes and not args.references:
        parser.error("give the folder of --references")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="files or built-in names; none: only the tables")
    add_references(parser)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--tails", nargs="+", default=list(TAILS), choices=list(TAILS))
    parser.add_argument("--samplers", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--groups", nargs="*", default=[], metavar="NAME=SCENE,...", help="scenes to take means over")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/tails.json"))
    args = parser.parse_args()
    check_references(parser, args)
    result = {
        "benchmark": "tails",
        "metadata": metadata("mitsuba", "drjit", "mitsuba-oidn", "onnxruntime"),
        "cells": [],
    }
    if args.output.exists():
        result["cells"] = json.loads(args.output.read_text())["cells"]
    for scene in args.scenes:
        for cell in measured(scene, args, {place(cell) for cell in result["cells"]}):
            result["cells"].append(cell)
            save(args.output, result)
            print(*place(cell), f"{cell['seconds']:.2f} s", flush=True)
    groups = dict(text.split("=", 1) for text in args.groups)
    show(result["cells"], {name: members.split(",") for name, members in groups.items()})


def place(cell: dict[str, Any]) -> tuple:
    return tuple(cell[name] for name in CELL)


def measured(scene: str, args: argparse.Namespace, known: set[tuple]):
    """The cells of a scene that are not ``known``, one after the other."""
    load_scene, render_stack = renderer()
    from data_gen.choosing.plans import plan_sampler

    # A kernel knows the shapes of all scenes in memory.
    gc.collect()
    loaded = load_scene(scene, tuple(map(int, args.size.split("x"))))
    reference = reference_of(loaded, scene, args)
    clean = clean_image(reference)
    chosen = plan_sampler(loaded, min(args.spp), None)
    for sampler in args.samplers:
        warm: set[str] = set()
        name, options = ("primal", RIVAL) if sampler == "mitsuba" else (sampler, {})
        for spp in args.spp:
            for seed in args.seeds:
                for tails in args.tails if sampler != "mitsuba" else ["paths"]:
                    values = (scene_name(scene), args.size, sampler, tails, spp, seed)
                    if values in known:
                        continue
                    if tails not in warm:
                        stack = render_stack(loaded, WARM_SPP, 0, name, tails=tails, **options)
                        for method in METHODS[sampler]:
                            image_of(stack, method)
                        warm.add(tails)
                    load, start = os.getloadavg()[0], processor_seconds()
                    stack = render_stack(loaded, spp, seed, name, tails=tails, **options)
                    cell = dict(zip(CELL, values, strict=True)) | {"seconds": processor_seconds() - start}
                    cell |= {"load average": load, "options": stack.attributes.get("ngpt:samplerOptions", "")}
                    if sampler == chosen.sampler and tails == "shared":
                        cell["auto"] = chosen.method or choose(stack)
                    yield cell | {"methods": {name: judged(stack, name, reference, clean) for name in METHODS[sampler]}}


def processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def reference_of(loaded: Any, scene: str, args: argparse.Namespace) -> Reference:
    from data_gen.render import render_stack

    args.references.mkdir(parents=True, exist_ok=True)
    files = [args.references / f"{scene_name(scene)}-{args.size}{half}.exr" for half in HALVES]
    for i, file in enumerate(files):
        if not file.exists():
            print(f"rendering {file}", flush=True)
            ngpt.write(file, render_stack(loaded, args.reference_spp, REFERENCE_SEED + i, "primal", tails="paths"))
    return read_reference(files)


def image_of(stack: ngpt.GradientStack, method: str) -> np.ndarray:
    return stack["primal"] if method == RAW else ngpt.reconstruct(stack, method).image


def judged(stack: ngpt.GradientStack, method: str, reference: Reference, clean: np.ndarray) -> dict[str, float | None]:
    """Seconds of the reconstruction, and ``VALUES``; no FLIP of the raw primal."""
    start = processor_seconds()
    image = image_of(stack, method)
    seconds = processor_seconds() - start if method != RAW else 0.0
    names = ["relMSE trimmed", *(["FLIP"] if method != RAW else [])]
    found = scores(names, image, *reference.images)
    coarse = relmse_trimmed(*(blocks(each.astype(np.float64)) for each in (image, *reference.images)))
    return {
        "seconds": seconds,
        "error": found["relMSE trimmed"],
        "steady": steady_error(image, reference, clean),
        "FLIP": found.get("FLIP"),
        "blocks": coarse**0.5 if coarse > 0 else None,
        "energy": float(image.mean(dtype=np.float64) / reference.mean.mean(dtype=np.float64)),
    }


def clean_image(reference: Reference) -> np.ndarray:
    """The denoised reference, (H, W, 3) double precision."""
    return np.mean([ngpt.reconstruct(half, "oidn").image for half in reference.stacks], axis=0, dtype=np.float64)


def steady_error(image: np.ndarray, reference: Reference, clean: np.ndarray) -> float:
    """relMSE by both halves of the reference, relative to the ``clean`` one, without the 0.1 % that are worst by it."""
    each = (squared_error(image, *halves) / (clean**2 + EPSILON) for halves in (reference.images, (clean,)))
    return trimmed_mean(*each, share=0.001)


def rows_of(cells: list[dict]) -> dict[tuple, dict[int, dict[str, dict]]]:
    """(scene, size, sampler, method) -> samples -> tails -> medians over seeds, also of ``render`` and ``whole``."""
    each: dict[tuple, dict[int, dict[str, list]]] = {}
    for cell in cells:
        for method, values in cell["methods"].items():
            line = values | {"render": cell["seconds"], "whole": cell["seconds"] + values["seconds"]}
            by_spp = each.setdefault((cell["scene"], cell["size"], cell["sampler"], method), {})
            by_spp.setdefault(cell["spp"], {}).setdefault(cell["tails"], []).append(line)
    return {
        key: {
            spp: {
                tails: {name: median(line.get(name) for line in lines) for name in ("render", "whole", *VALUES)}
                for tails, lines in by.items()
            }
            for spp, by in sorted(by_spp.items())
        }
        for key, by_spp in each.items()
    }


def ratios(by_spp: dict[int, dict[str, dict]], spp: int) -> dict[str, tuple[float, str]]:
    """Shared over paths, with marks: ``seconds``, and errors at equal samples and at equal whole time."""
    paths, shared = (by_spp[spp].get(tails) for tails in TAILS)
    found: dict[str, tuple[float, str]] = {}
    if not paths or not shared:
        return found
    found["seconds"] = shared["whole"] / paths["whole"], ""
    for name in ERRORS:
        if (shared[name] or 0) <= 0 or (paths[name] or 0) <= 0:
            continue
        found[f"{name}, samples"] = shared[name] / paths[name], ""
        lines = [by["paths"] for by in by_spp.values() if "paths" in by]
        points = [(line["whole"], line[name]) for line in lines if (line[name] or 0) > 0]
        if answer := error_at(shared["whole"], points):
            found[f"{name}, time"] = shared[name] / answer[0], answer[1]
    return found


RATIOS = ("seconds", *(f"{name}, {at}" for at in ("samples", "time") for name in ERRORS))


def show(cells: list[dict], groups: dict[str, list[str]]) -> None:
    rows = rows_of(cells)
    heads = ["scene", "sampler", "method", "spp", "render s", "whole s", *VALUES, *RATIOS]
    found: dict[tuple, dict[str, dict[str, tuple[float, str]]]] = {}
    lines = []
    for (scene, size, sampler, method), by_spp in rows.items():
        for spp, by in by_spp.items():
            told = ratios(by_spp, spp)
            found.setdefault((size, sampler, method, spp), {})[scene] = told
            values = [
                " / ".join(digits(by.get(t, {}).get(name)) for t in TAILS) for name in ("render", "whole", *VALUES)
            ]
            lines.append([f"{scene} {size}", sampler, method, str(spp), *values, *map(marked, map(told.get, RATIOS))])
    print("\ntails=paths / tails=shared, and the second over the first; seconds of processors")
    table(heads, lines)
    lines = []
    for name, members in groups.items():
        for (size, sampler, method, spp), by_scene in found.items():
            here = [told for scene, told in by_scene.items() if scene in members and "seconds" in told]
            if here:
                means = [over([told.get(key) for told in here]) for key in RATIOS]
                lines.append([f"{name} ({len(here)}) {size}", sampler, method, str(spp), *means])
    print("\ngeometric means over scenes")
    table(["scenes", "sampler", "method", "spp", *RATIOS], lines)
    for tails in TAILS:
        print(f"\ngradients, tails={tails}")
        told = worth_tables(evaluated(cells, tails, groups))
        for title, (head, *lines) in told.items():
            print(f"\n{title}")
            table(head, lines)
    for tails in sorted({cell["tails"] for cell in cells}):
        print(f"\npipelines after equal whole time, tails={tails}: error and FLIP relative to `primal` with `oidn`")
        table(["scenes", "processor s", *pipelines(), "mitsuba+oidn"], against_oidn(cells, tails, groups))
        if tails == "shared":
            print("\nwhat `ngpt render` and `ngpt denoise` take by default, relative to the best of our pipelines")
            table(["scenes", *(f"{seconds} s" for seconds in SECONDS)], default_over_best(cells, tails, groups))
    loads = [cell["load average"] for cell in cells]
    print(f"\nload average {min(loads):.1f} to {max(loads):.1f}")


def pipelines() -> dict[str, dict[str, str]]:
    """Columns of an evaluation; `oidn` reads no gradients."""
    pairs = [(sampler, method) for sampler, methods in METHODS.items() for method in methods]
    return {
        f"{sampler}+{method}": {"sampler": sampler, "stack": "gradients" if sampler == "gpt" else "primal"}
        for sampler, method in pairs
        if (sampler, method) != ("gpt", "oidn") and method != RAW and sampler != "mitsuba"
    }


def curves_of(cells: list[dict], tails: str) -> dict[str, dict[str, dict[str, list]]]:
    """Scene -> pipeline -> error and FLIP -> (whole seconds, value) of all ``pipelines`` and of Mitsuba."""
    curves: dict[str, dict[str, dict[str, list]]] = {}
    for (scene, _, sampler, method), by_spp in rows_of(cells).items():
        if (name := f"{sampler}+{method}") in (*pipelines(), "mitsuba+oidn"):
            each = "paths" if sampler == "mitsuba" else tails
            lines = [by[each] for by in by_spp.values() if each in by]
            points = {value: [(line["whole"], line[value]) for line in lines] for value in ("error", "FLIP")}
            curves.setdefault(scene, {})[name] = points
    return curves


def groups_of(curves: dict[str, Any], groups: dict[str, list[str]]) -> list[tuple[str, list[str]]]:
    """Each scene, and each group that has any, with the scenes that were measured."""
    known = [(name, [scene for scene in members if scene in curves]) for name, members in groups.items()]
    return [*((scene, [scene]) for scene in curves), *((name, members) for name, members in known if members)]


def against_oidn(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> list[list[str]]:
    """A row for each scene and group, and each of ``SECONDS``: error and FLIP of all ``pipelines`` and of Mitsuba."""
    curves = curves_of(cells, tails)

    def ratio(scene: str, name: str, value: str, seconds: float) -> tuple[float, str] | None:
        a, b = (error_at(seconds, curves[scene].get(each, {}).get(value, [])) for each in (name, "primal+oidn"))
        return (a[0] / b[0], joined((a[1], b[1]))) if a and b else None

    rows = []
    for label, here in groups_of(curves, groups):
        for seconds in SECONDS:
            values = [
                ", ".join(over([ratio(scene, name, value, seconds) for scene in here]) for value in ("error", "FLIP"))
                for name in (*pipelines(), "mitsuba+oidn")
            ]
            rows.append([label, str(seconds), *values])
    return rows


def default_over_best(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> list[list[str]]:
    """A row for each scene and group: error and FLIP of the default pipeline over the best, at each of ``SECONDS``."""
    curves = curves_of(cells, tails)
    taken = {cell["scene"]: f"{cell['sampler']}+{cell['auto']}" for cell in cells if "auto" in cell}

    def ratio(scene: str, value: str, seconds: float) -> tuple[float, str] | None:
        ours = {name: error_at(seconds, curves[scene][name][value]) for name in pipelines() if name in curves[scene]}
        known = {name: found for name, found in ours.items() if found}
        if taken.get(scene) not in known:
            return None
        mine, best = known[taken[scene]], min(known.values())
        return mine[0] / best[0], joined((mine[1], best[1]))

    return [
        [label, *(", ".join(over([ratio(s, v, t) for s in here]) for v in ("error", "FLIP")) for t in SECONDS)]
        for label, here in groups_of(curves, groups)
    ]


def evaluated(cells: list[dict], tails: str, groups: dict[str, list[str]]) -> dict[str, Any]:
    """The cells with these ``tails`` as results of `ngpt evaluate`, as far as ``worth_of_gradients`` reads them."""
    summary, renders = [], []
    for (scene, _, sampler, method), by_spp in rows_of(cells).items():
        name = f"{sampler}+{method}"
        for spp, by in by_spp.items():
            if name in pipelines() and tails in by:
                row, line = {"scene": scene, "method": name, "spp": spp}, by[tails]
                summary.append(row | {"error": line["error"], "seconds": {"total": line["whole"]}})
                renders.append(row | {"absent": None, "spp used": spp, "seconds": {"render": line["render"]}})
    settings = {"spp": sorted({cell["spp"] for cell in cells}), "groups": groups}
    scenes = list(dict.fromkeys(row["scene"] for row in summary))
    return {"scenes": scenes, "summary": summary, "cells": renders, "methods": pipelines(), "settings": settings}


def digits(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}" if value < 100 else f"{value:.0f}"


def marked(value: tuple[float, str] | None) -> str:
    return f"{value[1]}{value[0]:.2f}" if value else "-"


def over(values: list[tuple[float, str] | None]) -> str:
    """The geometric mean of the values as text, with its mark, if none is missing."""
    known = [value for value in values if value]
    if len(known) < len(values):
        return "-"
    return marked((geometric_mean(value for value, _ in known), joined(mark for _, mark in known)))


def table(head: list[str], lines: list[list[str]]) -> None:
    for line in (head, ["---"] * len(head), *lines):
        print(f"| {' | '.join(line)} |", flush=True)


if __name__ == "__main__":
    main()
