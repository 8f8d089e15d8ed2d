"""``ngpt advise``: which method, and how many samples, for the time there is or the error to reach."""

import argparse
import time
from dataclasses import asdict

from ngpt.cli.arguments import add_json, assignment, duration, natural, positive, print_json, size
from ngpt.measure.advice import advise, describe, read_table
from ngpt.system.console import Console


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a Mitsuba 3 scene file, or a built-in scene")
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--seconds", type=duration, help="time for rendering and reconstruction")
    goal.add_argument("--error", type=duration, metavar="ERROR", help="trimmed relMSE to reach")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the scene's own)")
    parser.add_argument("--pilot", type=positive, default=4, metavar="SPP", help="samples of the pilot (default: 4)")
    parser.add_argument("--seed", type=natural, default=0, help="of the pilot (default: 0)")
    parser.add_argument("--table", metavar="FILE", help="measurements, as `ngpt evaluate --advice FILE` writes them")
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb; cuda_ad_rgb for an NVIDIA GPU)")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    table = read_table(args.table)
    # Only the verbs that render import the renderer.
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    from data_gen.costs import measure
    from data_gen.samplers import choose
    from data_gen.scenes.facts import scene_facts
    from data_gen.scenes.load import load_scene
    from ngpt.evaluation.renders import DEFAULTS

    start = time.perf_counter()
    scene = load_scene(args.scene, args.size, dict(args.define))
    sampler, reason = choose(scene_facts(scene))
    # Gradients first, whose stack is the pilot.
    seconds, pilot = measure(scene, {render.name: render.options for render in DEFAULTS}, max(args.pilot, 2), 1)
    pixels = pilot.width * pilot.height
    cost = {kind: min(values) / pixels for kind, values in seconds.items()}
    advices = advise(table, describe(pilot), cost, pixels, seconds=args.seconds, error=args.error)
    console.say(
        f"{args.scene}: pilot of {max(args.pilot, 2)} spp, {time.perf_counter() - start:.1f} s with compilation"
    )
    if args.json:
        report = {"scene": args.scene, "size": [pilot.width, pilot.height], "sampler": sampler}
        print_json(report | {"advice": [asdict(a) for a in advices]})
        return 0
    console.say(f"{args.scene}: gradients by sampler '{sampler}': {reason}")
    print(
        f"{'method':18}{'stack':11}{'spp':>7}{'seconds':>9}{table.get('metric', 'error'):>16}{'likely':>20}{'best':>7}"
    )
    for a in advices:
        likely = f"{a.low:.2g} .. {a.high:.2g}"
        print(f"{a.method:18}{a.stack:11}{a.spp:7}{a.seconds:9.3g}{a.error:16.3g}{likely:>20}{a.sure:7.0%}")
    best = advices[0]
    option = "" if best.stack == "gradients" else " --sampler primal"
    console.say(f"ngpt render {args.scene} -o stack.exr --spp {best.spp}{option}; then method {best.method}")
    return 0
