"""A panel of 16 scenes of all kinds: compares the default and the shipped methods to the numbers in git.

    python -m bench.panel                          compares to bench/results/panel.json; exits with 1 if worse
    python -m bench.panel --scenes diffuse haze    compares only these scenes
    python -m bench.panel --baseline               measures three seeds, and writes panel.json and docs/lab/panel.md
    python -m bench.panel --table                  prints the tables of docs/lab/panel.md, without measuring
    python -m bench.panel --files a/scene.xml      prints these tables for other scenes, with three seeds

A cell is a scene, a number of samples and a pipeline, named SAMPLER+METHOD:

    auto+auto        the defaults of `render_scene` and `reconstruct`
    mitsuba+oidn     the rival: OIDN on Mitsuba's own points and lamps and whole paths (``bench.judging.RIVAL``)
    primal+oidn      the rival of pipelines with gradients: OIDN on our samples
    all others       methods that ship

The error is ``bench.judging.Judge.steady``; FLIP is relative to the mean of the reference's halves. Seconds are
processor seconds of render and method, with compiled kernels. References are kept in the folder --cache, and rendered
if they are not there. ``bench.verdict`` decides which values are worse than before, beyond noise.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import ngpt
from bench import verdict
from bench.common import metadata, save, write_page
from bench.curves import Ratio, marked, over, over_least
from bench.judging import RIVAL, WARM_SPP, Judge, open_judged, processor_seconds, timed
from ngpt.cli.arguments import size
from ngpt.errors import NgptError
from ngpt.measure.averages import geometric_mean
from ngpt.stack import GradientStack
from ngpt.subpixels import FEWEST
from ngpt.system.writing import markdown_table

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "bench" / "results" / "panel.json"
PAGE = ROOT / "docs" / "lab" / "panel.md"
MARKS = ("<!-- python -m bench.panel: tables -->", "<!-- tables end -->")
SIZE, SPP = (192, 108), (4, 16, 64)
METHODS = {
    "auto": ["auto"],
    "gpt": ["ngpt-combine", "ngpt-fast"],
    "primal": ["ngpt-primal", "oidn"],
    "mitsuba": ["oidn"],
}
DEFAULT = "auto+auto"
OURS = [f"{sampler}+{method}" for sampler in ("gpt", "primal") for method in METHODS[sampler]]
PIPELINES = [DEFAULT, *OURS, "mitsuba+oidn"]
SEEDS = tuple(range(1, 1 + verdict.LEAST_SEEDS))
EQUAL = ("samples", "seconds")
# Pipelines that the default is compared with one by one, after equal seconds.
RIVALS = ("mitsuba+oidn", "gpt+ngpt-combine")
# The least error: smaller ones cannot be measured by the halves of a reference.
_LEAST_ERROR = 1e-6


class Case(NamedTuple):
    """A scene of the panel: kind, group, the argument of ``judging.opened``, samples of each half of a reference."""

    kind: str
    group: str
    scene: str
    reference_spp: int = 256


def _file(name: str) -> str:
    return str(ROOT / "bench" / "scenes" / name / "scene.xml")


CASES = {
    "diffuse": Case("room", "rooms", "diffuse"),
    "glossy": Case("room of metal and mirrors", "rooms", "glossy"),
    "checks": Case("textures", "rooms", _file("checks")),
    "crowd": Case("instances", "rooms", _file("crowd")),
    "lampshade": Case("hidden lamp", "hidden lamps", _file("lampshade")),
    "ajar": Case("light through a gap", "hidden lamps", _file("ajar"), 512),
    "trellis": Case("masks", "masks", _file("trellis")),
    "environment": Case("sky", "sky, blur", "environment"),
    "lens": Case("focus blur", "sky, blur", "lens"),
    "product": Case("product shot", "products", _file("product"), 512),
    "mirror-caustic": Case("caustics in a mirror", "glass, mirrors", _file("mirror-caustic"), 1024),
    "haze": Case("fog", "media", "haze"),
    "smoke": Case("smoke", "media", "smoke"),
    "cloud": Case("cloud", "media", "cloud"),
    "generator-20261128-caustic": Case("glass, of the generator", "glass, mirrors", "generator:20261128:caustic", 512),
    "generator-20261129-mirrors": Case("mirrors, of the generator", "glass, mirrors", "generator:20261129:mirrors"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(CASES), choices=list(CASES), metavar="SCENE")
    parser.add_argument("--baseline", action="store_true", help="the cells of these scenes become the numbers in git")
    parser.add_argument("--table", action="store_true", help="print the tables of the numbers in git")
    parser.add_argument("--files", nargs="+", metavar="SCENE", help="tables of these files, which are not in the panel")
    parser.add_argument("--size", type=size, default="320x180", help="of the images of --files (default: %(default)s)")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "panel", help="folder for references")
    args = parser.parse_args()
    if args.files:
        found = measured(args.files, args.cache, SEEDS, args.size)
        print(text([cell for cells in found for cell in cells]))
        return 0
    before = json.loads(RESULT.read_text())["cells"] if RESULT.exists() else []
    if args.table:
        print(text(before))
        return 0
    if args.baseline:
        for found in measured(args.scenes, args.cache, SEEDS):
            before = [cell for cell in before if cell["scene"] != found[0]["scene"]] + found
            about = metadata("mitsuba", "drjit", "mitsuba-oidn", "onnxruntime")
            save(RESULT, {"benchmark": "panel", "size": list(SIZE), "metadata": about, "cells": before})
        write_page(PAGE, text(before), MARKS)
        return 0
    cells = [cell for found in measured(args.scenes, args.cache, SEEDS[:1]) for cell in found]
    judged = verdict.compare(cells, before)
    if worse := [each for each in judged if each.worse]:
        print(f"{len(worse)} ratios are worse with one seed; measuring these scenes with all seeds", flush=True)
        scenes = args.scenes if any(each.key[0] == verdict.MEAN for each in worse) else {e.key[0] for e in worse}
        for found in measured([name for name in args.scenes if name in scenes], args.cache, SEEDS[1:]):
            cells = verdict.joined(cells, found)
        judged = verdict.compare(cells, before)
    print(text(cells), "", *ratio_table(judged), "", sep="\n")
    worse = [each for each in judged if each.worse]
    for each in worse:
        limit = f"limit {verdict.LIMITS[each.value]:g}, {verdict.DEVIATIONS:g} deviations {each.reach:.2f}"
        print(f"worse: {', '.join(each.key)}: {each.value} {each.ratio:.3f} times as large as before ({limit})")
    print(f"{len(worse)} of {len(judged)} ratios are worse beyond noise")
    return 1 if worse else 0


def measured(
    names: Sequence[str], cache: Path, seeds: Sequence[int], size: tuple[int, int] = SIZE
) -> Iterator[list[dict[str, Any]]]:
    """Yields the cells of each scene, a name of ``CASES`` or a file. Prints the time so far, without references."""
    seconds = used = 0.0
    for scene in names:
        case = CASES.get(scene) or Case("", "", scene)
        name, loaded, judge = open_judged(case.scene, "{}x{}".format(*size), cache, case.reference_spp)
        start, start_used = time.perf_counter(), processor_seconds()
        yield cells_of(name, loaded, judge, seeds)
        seconds, used = seconds + time.perf_counter() - start, used + processor_seconds() - start_used
        print(f"{name}: {seconds:.0f} s in all, {used:.0f} s of processors", flush=True)


def cells_of(name: str, loaded: Any, judge: Judge, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """The cells of a scene, with error, FLIP and seconds by seed."""
    for sampler, methods in METHODS.items():
        # From FEWEST samples on, the default has subpixels, and so other kernels.
        for few in (WARM_SPP, FEWEST):
            stack = render(loaded, sampler, few, 0)
            for method in methods:
                ngpt.reconstruct(stack, method)
    cells = []
    for spp in SPP:
        by_pipeline: dict[str, dict[str, Any]] = {pipeline: {} for pipeline in PIPELINES}
        for seed in seeds:
            for pipeline, values in of_seed(loaded, spp, seed, judge).items():
                for value, number in values.items():
                    by_pipeline[pipeline].setdefault(value, {})[str(seed)] = number
        cells += [{"scene": name, "spp": spp, "pipeline": each} | values for each, values in by_pipeline.items()]
    return cells


def of_seed(loaded: Any, spp: int, seed: int, judge: Judge) -> dict[str, dict[str, float]]:
    """Pipeline -> values. The pipeline that the default chooses is not rendered and denoised a second time."""
    found: dict[str, dict[str, float]] = {}
    stacks: dict[str, tuple[GradientStack, float]] = {}
    for sampler, methods in METHODS.items():
        stack, seconds = stacks.get(sampler) or timed(partial(render, loaded, sampler, spp, seed))
        for method in methods:
            if (pipeline := f"{sampler}+{method}") in found:
                continue
            result, more = timed(partial(ngpt.reconstruct, stack, method))
            values = judge.values(result.image) | {"seconds": seconds + more}
            values["error"] = max(values["error"], _LEAST_ERROR)
            found[pipeline] = {value: float(f"{number:.4g}") for value, number in values.items()}
            if pipeline == DEFAULT:
                taken = str(stack.attributes["ngpt:sampler"])
                stacks[taken] = stack, seconds
                found[f"{taken}+{result.method}"] = found[pipeline]
    return {pipeline: found[pipeline] for pipeline in PIPELINES}


def render(loaded: Any, sampler: str, spp: int, seed: int) -> GradientStack:
    """A stack by the sampler, with the defaults of `ngpt render`, or with Mitsuba's own points and lamps."""
    from data_gen import render_scene

    options: dict[str, Any] = RIVAL | {"tails": "paths", "subpixels": 1} if sampler == "mitsuba" else {}
    return render_scene(loaded, spp, seed, "primal" if options else sampler, **options).stack


def text(cells: list[dict[str, Any]]) -> str:
    """The tables as Markdown.

    They show error and FLIP of all pipelines; the default over two rivals; our other pipelines over the default; and
    the default over the best of our other pipelines.
    """
    of = {verdict.key_of(cell): cell for cell in cells}
    scenes = list(dict.fromkeys(cell["scene"] for cell in cells))
    rows = []
    for scene in scenes:
        for spp in SPP:
            of_all = (of[scene, str(spp), pipeline] for pipeline in PIPELINES)
            values = (f"{mean_of(cell, 'error'):.2g}, {mean_of(cell, 'FLIP'):.3f}" for cell in of_all)
            shown = f"{scene} ({CASES[scene].kind})" if scene in CASES else scene
            rows.append([shown, str(spp), *values])
    lines = ["Error, FLIP:", "", *markdown_table(["scene", "spp", *PIPELINES], rows), ""]
    rows = []
    for scene in scenes:
        for spp in SPP:
            ratios = (over_best(of, scene, spp, "seconds", [rival]) for rival in RIVALS)
            seconds = f"{mean_of(of[scene, str(spp), DEFAULT], 'seconds'):.2g}"
            rows.append([scene, str(spp), seconds, *(", ".join(map(marked, each)) for each in ratios)])
    lines += ["The default over two rivals after equal seconds of processors, error and FLIP:", ""]
    lines += [*markdown_table(["scene", "spp", "seconds", *RIVALS], rows), ""]
    lines += ["Our other pipelines over the default after equal seconds, error and FLIP, by kinds of scenes:", ""]
    lines += [*markdown_table(["scenes", "pipeline", *(f"{spp} spp" for spp in SPP)], rows_by_group(of, scenes)), ""]
    best = {scene: [over_best(of, scene, spp, equal) for equal in EQUAL for spp in SPP] for scene in scenes}
    rows = [[scene, *(", ".join(map(marked, each)) for each in columns)] for scene, columns in best.items()]
    means = [
        ", ".join(over([each[i] for each in column]) for i in (0, 1)) for column in zip(*best.values(), strict=True)
    ]
    heads = [f"{spp} spp, equal {equal}" for equal in EQUAL for spp in SPP]
    lines += ["The default over the best of our other pipelines, error and FLIP:", ""]
    lines += markdown_table(["scene", *heads], [*rows, ["mean", *means]])
    return "\n".join(lines)


def mean_of(cell: dict[str, Any], value: str) -> float:
    return geometric_mean(cell[value].values())


def rows_by_group(of: dict[verdict.Key, dict[str, Any]], scenes: Sequence[str]) -> Iterator[list[str]]:
    """Rows of our other pipelines over the default, by kinds of scenes: geometric means of error and FLIP."""
    groups: dict[str, list[str]] = {}
    for scene in scenes:
        groups.setdefault(CASES[scene].group if scene in CASES else "files", []).append(scene)
    for group, members in groups.items():
        for pipeline in OURS:
            places = [(scene, str(spp)) for scene in members for spp in SPP]
            if all(of[*place, pipeline]["error"] == of[*place, DEFAULT]["error"] for place in places):
                continue  # The default has chosen this pipeline everywhere.
            by_spp = ([over_best(of, scene, spp, "seconds", [DEFAULT], pipeline) for scene in members] for spp in SPP)
            yield [
                group,
                pipeline,
                *(", ".join(over([each[i] for each in ratios]) for i in (0, 1)) for ratios in by_spp),
            ]


def over_best(
    of: dict[verdict.Key, dict[str, Any]],
    scene: str,
    spp: int,
    equal: str,
    others: Sequence[str] = OURS,
    pipeline: str = DEFAULT,
) -> list[Ratio | None]:
    """Error and FLIP of the ``pipeline`` over the least of the ``others``, with the marks of ``bench.curves``.

    ``equal``  "samples" compares at the same number of samples, "seconds" after the same seconds
    """
    this, found = of[scene, str(spp), pipeline], []
    for value in verdict.LIMITS:
        error = mean_of(this, value)
        if equal == "samples":
            found.append((error / min(mean_of(of[scene, str(spp), each], value) for each in others), ""))
        else:
            curves = ([of[scene, str(n), each] for n in SPP] for each in others)
            points = ([(mean_of(cell, "seconds"), mean_of(cell, value)) for cell in curve] for curve in curves)
            found.append(over_least(error, mean_of(this, "seconds"), points))
    return found


def ratio_table(judged: list[verdict.Judged]) -> list[str]:
    """The lines of a table: error and FLIP over those in git. Ratios that are worse beyond noise are bold."""
    shown: dict[tuple[str, str], dict[str, list[str]]] = {}
    for each in judged:
        scene, spp, pipeline = each.key
        ratio = f"**{each.ratio:.2f}**" if each.worse else f"{each.ratio:.2f}"
        shown.setdefault((scene, spp), {}).setdefault(pipeline, []).append(ratio)
    rows = [[*place, *(", ".join(by[each]) for each in PIPELINES)] for place, by in shown.items()]
    return ["Over the numbers in git, error and FLIP:", "", *markdown_table(["scene", "spp", *PIPELINES], rows)]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except NgptError as error:
        sys.exit(f"error: {error}")
