"""``ngpt advise``: finds the sampler, the method and the number of samples for a given time or error."""

from __future__ import annotations

import argparse
import math
import shlex
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ngpt.cli.arguments import add_json, assignment, duration, print_json, size
from ngpt.errors import NgptError
from ngpt.system.console import Console, brief, tell

if TYPE_CHECKING:
    from data_gen.choosing.pipelines import Pipeline


# The advice is always below this number of samples per pixel.
LARGEST_SPP = 1 << 20
# Seconds that the trials may take
_LONGEST = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene")
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--seconds", type=duration, help="time for rendering and denoising together")
    goal.add_argument("--error", type=duration, metavar="ERROR", help="error to reach (trimmed relMSE)")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the scene's own)")
    parser.add_argument(
        "--sensor", metavar="NAME|N", help="sensor of the scene: its id, or its number from 0 (default: the first)"
    )
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb; cuda_ad_rgb for an NVIDIA GPU)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    add_json(parser)


@dataclass(frozen=True)
class Row:
    sampler: str
    method: str
    adaptive: bool
    spp: int
    seconds: float  # of sampler and method together
    error: float


def run(args: argparse.Namespace, console: Console) -> int:
    """Prints what each sampler and method is expected to achieve, judged by small renders of the scene."""
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.choosing.plans import LEAST_SECONDS, SHARE, explore
    from data_gen.choosing.trials import Pilot
    from data_gen.scenes.load import load_scene

    start = time.perf_counter()
    scene = load_scene(args.scene, args.size, dict(args.define), sensor=args.sensor)
    # The trials take at most as long as the render for which advice is given. If the machine is too busy for them, only
    # the first sampler is tried, on a small image.
    longest = _LONGEST / SHARE
    whole = longest if args.seconds is None else min(max(args.seconds / SHARE, LEAST_SECONDS), longest)
    seen = explore(scene, whole, pilot=Pilot(said=console.say), patient=True)
    if not seen:
        raise NgptError(f"{args.scene}: no sampler can render it; `ngpt info` says what it holds")
    found = rows_of(seen, args.seconds, args.error)
    console.say(f"{args.scene}: pilot of {time.perf_counter() - start:.1f} s with compilation")
    if args.json:
        film = scene.sensors()[0].film().crop_size()
        rows = [asdict(row) | {"commands": commands_of(row, args)} for row in found]
        report = {"scene": args.scene, "size": [int(n) for n in film], "sampler": found[0].sampler}
        print_json(report | {"advice": rows})
        return 0
    tell(f"{'sampler':12}{'method':16}{'samples':12}{'spp':>7}{'seconds':>9}{'relMSE trimmed':>16}")
    for row in found:
        shared = "adaptive" if row.adaptive else "even"
        tell(f"{row.sampler:12}{row.method:16}{shared:12}{row.spp:7}{row.seconds:9.3g}{row.error:16.3g}")
    for line in ("", *commands_of(found[0], args)):
        tell(line)
    return 0


def rows_of(pipelines: list[Pipeline], seconds: float | None, error: float | None) -> list[Row]:
    """The best pipeline of each sampler and method, adaptive or not, within ``seconds`` or for the ``error``; the
    recommended one comes first. Raises NgptError where none fits."""
    found = []
    for p in pipelines:
        spp = math.floor(p.samples(seconds)) if seconds is not None else math.ceil(p.needed(error or math.inf))
        if max(p.least, 2) <= spp < LARGEST_SPP:
            found.append(Row(p.sampler, p.method, p.shared, spp, p.takes(spp), p.expected(spp)))
    if not found and seconds is not None:
        least = min(p.takes(max(p.least, 2)) for p in pipelines)
        raise NgptError(f"nothing fits into {seconds:g} s: the cheapest takes {brief(least)} s")
    if not found:
        raise NgptError(
            f"no method reaches an error of {error:g} with fewer than {LARGEST_SPP} samples; allow a larger error"
        )
    found.sort(key=lambda row: row.error if seconds is not None else row.seconds)
    best: dict[tuple[str, str], Row] = {}
    for row in found:
        best.setdefault((row.sampler, row.method), row)
    return list(best.values())


def commands_of(row: Row, args: argparse.Namespace) -> list[str]:
    """The commands for a row: one renders the stack, and one denoises it."""
    stem = f"{Path(args.scene).stem}-{row.spp}spp"
    adaptive = ["--adaptive"] if row.adaptive else []
    render = ["ngpt", "render", args.scene, "-o", f"{stem}.exr", "--spp", str(row.spp), "--sampler", row.sampler]
    denoise = ["ngpt", "denoise", f"{stem}.exr", "-o", f"{stem}-{row.method}.exr", "--method", row.method]
    return [shlex.join([*render, *adaptive, *of_the_scene(args)]), shlex.join(denoise)]


def of_the_scene(args: argparse.Namespace) -> list[str]:
    """The options of this command that ``ngpt render`` also has."""
    words = ["--size", "{}x{}".format(*args.size)] if args.size else []
    words += ["--sensor", args.sensor] if args.sensor is not None else []
    words += ["--variant", args.variant] if args.variant else []
    return words + [word for name, value in args.define for word in ("-D", f"{name}={value}")]
