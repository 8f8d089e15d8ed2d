"""``ngpt advise``: which sampler and method, and how many samples, for the time there is or the error to reach."""

from __future__ import annotations

import argparse
import math
import shlex
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ngpt.cli.arguments import add_json, assignment, duration, natural, positive, print_json, size
from ngpt.errors import NgptError
from ngpt.measure.advice import LARGEST_SPP, Advice, advise, describe, read_table, relative_noise
from ngpt.methods import METHODS
from ngpt.system.console import Console

if TYPE_CHECKING:
    from data_gen.choosing.pilot import Choice
    from data_gen.choosing.pipelines import Pipeline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene")
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--seconds", type=duration, help="time for rendering and reconstruction")
    goal.add_argument("--error", type=duration, metavar="ERROR", help="trimmed relMSE to reach")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the scene's own)")
    parser.add_argument(
        "--table",
        metavar="FILE",
        help="go by measurements of other scenes, as `ngpt evaluate --advice FILE` writes them, and a smaller pilot; "
        "'shipped' stands for those of the package",
    )
    parser.add_argument(
        "--pilot", type=positive, default=4, metavar="SPP", help="with --table: samples of the pilot (default: 4)"
    )
    parser.add_argument("--seed", type=natural, default=0, help="with --table: of the pilot (default: 0)")
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb; cuda_ad_rgb for an NVIDIA GPU)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    add_json(parser)


@dataclass(frozen=True)
class Row:
    """A sampler and a method, with samples even or shared out (``adaptive``); ``seconds`` are those of both."""

    sampler: str
    method: str
    adaptive: bool
    spp: int
    seconds: float
    error: float


def run(args: argparse.Namespace, console: Console) -> int:
    return by_pilot(args, console) if args.table is None else by_table(args, console)


def by_pilot(args: argparse.Namespace, console: Console) -> int:
    """What each sampler and method is expected to do, by small renders of this scene."""
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.choosing.pipelines import LONG, explore
    from data_gen.scenes.load import load_scene

    start = time.perf_counter()
    scene = load_scene(args.scene, args.size, dict(args.define))
    found = rows_of(explore(scene, args.seconds or LONG), args.seconds, args.error)
    console.say(f"{args.scene}: pilot of {time.perf_counter() - start:.1f} s with compilation")
    if args.json:
        film = scene.sensors()[0].film().crop_size()
        rows = [asdict(row) | {"commands": commands_of(row, args)} for row in found]
        report = {"scene": args.scene, "size": [int(n) for n in film], "sampler": found[0].sampler}
        print_json(report | {"advice": rows})
        return 0
    print(f"{'sampler':12}{'method':16}{'samples':12}{'spp':>7}{'seconds':>9}{'relMSE trimmed':>16}")
    for row in found:
        shared = "adaptive" if row.adaptive else "even"
        print(f"{row.sampler:12}{row.method:16}{shared:12}{row.spp:7}{row.seconds:9.3g}{row.error:16.3g}")
    print("", *commands_of(found[0], args), sep="\n")
    return 0


def rows_of(pipelines: list[Pipeline], seconds: float | None, error: float | None) -> list[Row]:
    """The best of each sampler and method, adaptive or not, in so many ``seconds`` or to the ``error``; the one to take
    first. Raises NgptError where none fits."""
    found = []
    for p in pipelines:
        spp = math.floor(p.samples(seconds)) if seconds is not None else math.ceil(p.needed(error))
        if max(p.least, 2) <= spp < LARGEST_SPP:
            found.append(Row(p.sampler, p.method, p.shared, spp, p.takes(spp), p.expected(spp)))
    if not found and seconds is not None:
        least = min(p.takes(max(p.least, 2)) for p in pipelines)
        raise NgptError(f"nothing fits into {seconds:g} s: the cheapest takes {least:.2g} s")
    if not found:
        raise NgptError(f"no method reaches an error of {error:g} with fewer than {LARGEST_SPP} samples; ask for more")
    found.sort(key=lambda row: row.error if seconds is not None else row.seconds)
    best: dict[tuple[str, str], Row] = {}
    for row in found:
        best.setdefault((row.sampler, row.method), row)
    return list(best.values())


def commands_of(row: Row, args: argparse.Namespace) -> list[str]:
    """What to type for that row: a line that renders the stack, and one that denoises it."""
    stem = f"{Path(args.scene).stem}-{row.spp}spp"
    adaptive = ["--adaptive"] if row.adaptive else []
    render = ["ngpt", "render", args.scene, "-o", f"{stem}.exr", "--spp", str(row.spp), "--sampler", row.sampler]
    denoise = ["ngpt", "denoise", f"{stem}.exr", "-o", f"{stem}-{row.method}.exr", "--method", row.method]
    return [shlex.join([*render, *adaptive, *of_the_scene(args)]), shlex.join(denoise)]


def of_the_scene(args: argparse.Namespace) -> list[str]:
    """The options of this call that are those of a render too."""
    words = ["--size", "{}x{}".format(*args.size)] if args.size else []
    words += ["--variant", args.variant] if args.variant else []
    return words + [word for name, value in args.define for word in ("-D", f"{name}={value}")]


def by_table(args: argparse.Namespace, console: Console) -> int:
    """What each method is expected to do, by laws that were fitted on other scenes."""
    table = read_table(None if args.table == "shipped" else args.table)
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.choosing.pipelines import LONG
    from data_gen.scenes.load import load_scene

    start = time.perf_counter()
    scene = load_scene(args.scene, args.size, dict(args.define))
    choice = choose_sampler(scene, set(table["methods"].values()), args.seconds or LONG)
    seconds, pilot, described = measured(scene, choice, args)
    pixels = pilot.width * pilot.height
    cost = {kind: min(values) / pixels for kind, values in seconds.items()}
    sampler, reason = choice.sampler, choice.reason
    advices = advise(table, described, cost, pixels, seconds=args.seconds, error=args.error)
    console.say(
        f"{args.scene}: pilot of {max(args.pilot, 2)} spp, {time.perf_counter() - start:.1f} s with compilation"
    )
    lacks = {a.method: absence(call(a.method, table)[0]) for a in advices}
    if args.json:
        report = {"scene": args.scene, "size": [pilot.width, pilot.height], "sampler": sampler}
        report["because"] = reason
        rows = [
            asdict(a) | {"missing": lacks[a.method], "commands": commands(a, args, table, sampler)} for a in advices
        ]
        print_json(report | {"advice": rows})
        return 0
    console.say(f"{args.scene}: sampler '{sampler}': {reason}")
    print(
        f"{'method':18}{'stack':11}{'spp':>7}{'seconds':>9}{table.get('metric', 'error'):>16}{'likely':>20}{'best':>7}"
    )
    for a in advices:
        likely = f"{a.low:.2g} .. {a.high:.2g}"
        note = f"  not here: {lacks[a.method]}" if lacks[a.method] else ""
        print(f"{a.method:18}{a.stack:11}{a.spp:7}{a.seconds:9.3g}{a.error:16.3g}{likely:>20}{a.sure:7.0%}{note}")
    # The best of those that run here; the table goes on for those who can install what another lacks.
    best = next((a for a in advices if not lacks[a.method]), None)
    if best is None:
        raise NgptError(f"none of these methods runs here; {advices[0].method}: {lacks[advices[0].method]}")
    print("", *commands(best, args, table, sampler), sep="\n")
    return 0


def choose_sampler(scene, kinds: set[str], seconds: float) -> Choice:
    """The sampler of the scene for so many ``seconds``, compared with others by a pilot; of those alone that render
    the ``kinds`` of stacks that methods read."""
    from data_gen.choosing.pilot import Choice, best_of, seen
    from data_gen.choosing.trials import candidates, try_all
    from data_gen.samplers import SAMPLERS, choose
    from data_gen.scenes.facts import scene_facts

    default, reason = choose(scene_facts(scene))
    names = [
        name
        for name in candidates(scene)
        if name == default or ("gradients" in kinds if SAMPLERS[name].gradients else kinds - {"gradients"})
    ]
    if len(names) == 1 or default not in (trials := try_all(scene, names)):
        return Choice(default, reason)
    return Choice(*best_of(seen(trials), seconds))


def measured(scene, choice: Choice, args: argparse.Namespace):
    """Seconds per sample by kind of stack, a stack of the chosen sampler, and what pilots tell of the scene.

    A sampler without gradients renders the other kinds in place of ``primal``; there is nothing to win by gradients
    then, since a pilot has compared its images with theirs.
    """
    from data_gen.choosing.costs import measure
    from data_gen.samplers import SAMPLERS
    from ngpt.evaluation.renders import DEFAULTS

    entry = SAMPLERS[choice.sampler]
    spp = max(args.pilot, 2, 2 * entry.batch)
    renders = {render.kind: render.options for render in DEFAULTS}
    if entry.gradients:
        # Gradients first, whose stack is the pilot.
        renders["gradients"] = {"sampler": entry.name}
        seconds, pilot = measure(scene, renders, spp, 1, args.seed)
        return seconds, pilot, describe(pilot)
    seconds, gradients = measure(scene, {"gradients": renders["gradients"]}, spp, 1, args.seed)
    if entry.name == "primal":
        renders.pop("gradients")
        seconds, pilot = measure(scene, renders, spp, 1, args.seed)
    else:
        seconds, pilot = measure(scene, {"features": {"sampler": entry.name}}, spp, 1, args.seed)
        seconds["path"] = seconds["features"]
    return seconds, pilot, describe(gradients) | {"noise": relative_noise(pilot)}


def call(name: str, table: dict) -> tuple[str, dict]:
    """What a row of the table is to ``ngpt denoise``: a method, and options that are not its defaults."""
    entry = table.get("calls", {}).get(name, {})
    return entry.get("method", name), entry.get("options", {})


def absence(method: str) -> str:
    """Why a method cannot be used here, "" if it can."""
    return METHODS[method].missing() if method in METHODS else f"this version has no method '{method}'"


def commands(advice: Advice, args: argparse.Namespace, table: dict, sampler: str) -> list[str]:
    """What to type to follow the advice: a line that renders the stack, and one that denoises it."""
    from data_gen.samplers import SAMPLERS

    stem = f"{Path(args.scene).stem}-{advice.spp}spp"
    render = ["ngpt", "render", args.scene, "-o", f"{stem}.exr", "--spp", str(advice.spp)]
    # Gradients that are not wanted are not rendered.
    render += ["--sampler", "primal" if SAMPLERS[sampler].gradients and advice.stack != "gradients" else sampler]
    render += of_the_scene(args)
    method, options = call(advice.method, table)
    denoise = ["ngpt", "denoise", f"{stem}.exr", "-o", f"{stem}-{advice.method}.exr", "--method", method]
    for name, value in options.items():
        denoise += ["-O", f"{name}={value}"]
    return [shlex.join(render), shlex.join(denoise)]
