"""``ngpt demo``: everything once, on the built-in scenes, ending in a report."""

import argparse
import platform
import shlex
import time
from pathlib import Path

import numpy as np

from data_gen.cli import KERNELS
from ngpt.cli.arguments import add_force, positive, size
from ngpt.errors import WrongUse, did_you_mean
from ngpt.io.exr import write
from ngpt.measure.metrics import METRICS
from ngpt.measure.shown import available, judge
from ngpt.methods import METHODS, reconstruct
from ngpt.report.content import ReportEntry, Scene, median
from ngpt.report.page import oversize, write_report
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.files import check_output, make_folder
from ngpt.version import __version__

LAYER_VIEWS = ("dx", "dy", "albedo", "normal", "depth")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", default="demo", metavar="DIR", help="output folder (default: demo)")
    parser.add_argument(
        "--scene",
        action="append",
        metavar="NAME",
        help="built-in scene; may be repeated (default: all scenes without media)",
    )
    parser.add_argument("--spp", type=positive, default=16, help="paths per pixel of the stacks (default: 16)")
    parser.add_argument(
        "--reference-spp", type=positive, default=1024, help="paths per pixel of the references (default: 1024)"
    )
    parser.add_argument("--size", type=size, default=(240, 160), metavar="WxH", help="pixels (default: 240x160)")
    parser.add_argument("--variant", help="Mitsuba variant (default: llvm_ad_rgb)")
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(args.variant or DEFAULT_VARIANT)
    import mitsuba as mi

    from data_gen.scenes.builtin import SCENES, SURFACES

    names = args.scene or list(SURFACES)
    for name in names:
        if name not in SCENES:
            meant = did_you_mean(name, SCENES)
            raise WrongUse(f"no built-in scene is called '{name}'; {meant}those are: {', '.join(SCENES)}")
    folder = make_folder(args.output)
    report = check_output(folder / "report.html", args.force)
    start = time.perf_counter()
    scenes = [demo_scene(name, args, folder, console) for name in names]
    words = ["--spp", str(args.spp), "--reference-spp", str(args.reference_spp), "--size", "{}x{}".format(*args.size)]
    command = shlex.join(["ngpt", "demo", *words, *(word for name in args.scene or [] for word in ("--scene", name))])
    footer = {
        "ngpt": __version__,
        "Mitsuba": f"{mi.__version__} ({mi.variant()})",
        "NumPy": np.__version__,
        "Python": platform.python_version(),
        "whole run": f"{time.perf_counter() - start:.0f} s",
    }
    write_report(report, "ngpt demo", scenes, command=command, footer=footer, overwrite=args.force)
    print_table(scenes)
    if large := oversize(report):
        console.say(f"{large} (--scene, --size)")
    console.say(f"report: {report} (open it in a browser), {time.perf_counter() - start:.0f} s in all")
    return 0


def demo_scene(name: str, args: argparse.Namespace, folder: Path, console: Console) -> Scene:
    """Renders one scene with its reference, runs every method on it, and writes all of the images."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    # Studies take longer than all others together.
    methods = {m: entry for m, entry in METHODS.items() if not entry.variant and entry.standing != "study"}
    targets = {label: check_output(folder / f"{name}_{label}.exr", args.force) for label in ("stack", "ref", *methods)}
    scene = load_scene(name, args.size)
    with console.progress(f"{name}: stack", "spp", begins=KERNELS) as progress:
        stack = render_stack(scene, args.spp, progress=progress, unbiased=True, gradients=True)
    # Another seed than the stack's: a reference must not share its noise.
    with console.progress(f"{name}: reference", "spp", begins=KERNELS) as progress:
        reference = render_stack(scene, args.reference_spp, seed=1, sampler="primal", progress=progress, unbiased=True)[
            "primal"
        ]
    write(targets["stack"], stack, overwrite=args.force)
    write(targets["ref"], reference, overwrite=args.force)
    entries = []
    for method, entry in methods.items():
        if lack := entry.missing():
            console.say(f"{name}: without {method}: {lack}")
        elif all(layer in stack for layer in entry.needs):
            entries.append(demo_method(method, stack, reference, targets[method], args.force))
    caption = (
        f"{stack.width}x{stack.height}, {args.spp} spp, rendered in {stack.attributes['ngpt:seconds']:.1f} s; "
        f"reference {args.reference_spp} spp of Mitsuba's own integrator"
    )
    layers = {layer: stack[layer] for layer in LAYER_VIEWS if layer in stack}
    rising = [name for name, metric in METRICS.items() if metric.better == "higher"]
    return Scene(name, caption, reference, entries, layers, rising)


def demo_method(method: str, stack: GradientStack, reference: np.ndarray, target: Path, force: bool) -> ReportEntry:
    result = reconstruct(stack, method)
    write(target, result.image, like=stack, overwrite=force, attributes=result.attributes)
    metrics, maps = judge(available(stack.height, stack.width)[0], result.image, reference)
    return ReportEntry(method, result.image, result.seconds, metrics, maps)


def print_table(scenes: list[Scene]) -> None:
    print(f"{'scene':14}{'method':14}{'relMSE trimmed':>16}{'of primal':>12}{'seconds':>10}")
    for scene in scenes:
        for entry in scene.entries:
            error = median(entry.metrics["relMSE trimmed"])
            share = error / max(median(scene.entries[0].metrics["relMSE trimmed"]), 1e-30)
            print(f"{scene.name:14}{entry.name:14}{error:16.5f}{share:12.1%}{entry.seconds:10.2f}")
