"""``ngpt denoise``: from gradient stacks to images."""

import argparse
import time
from collections import defaultdict
from collections.abc import Container
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ngpt.api import lightgroups
from ngpt.api.uncertainty import reconstruct_with_error
from ngpt.cli import arguments
from ngpt.cli.denoise_files import Frame, describe, output_paths, write_frame
from ngpt.cli.denoise_shot import motion_hint, one_view_only, way, windowed
from ngpt.cli.picture import add_look, check_picture
from ngpt.cli.reference import Reference
from ngpt.cli.streams import STREAM, as_files
from ngpt.errors import NgptError, WrongUse
from ngpt.io.exr import read, read_views
from ngpt.io.foreign.files import first_attributes
from ngpt.io.frames import RESULT_SUFFIX, is_shot, remarks
from ngpt.io.reduced import REDUCED, check_reducible, smaller
from ngpt.io.whole import finished
from ngpt.methods import METHODS, by_standing, check_request, reconstruct
from ngpt.network.identity import identify
from ngpt.network.run_onnx import MEMORY
from ngpt.options import as_text, settings, unusual
from ngpt.panorama import wrapping
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import Network
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.limits import limit_threads
from ngpt.system.pipeline import overlapped


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "stacks",
        nargs="+",
        metavar="STACK",
        help="images (.exr .pfm .hdr .png .tif .jpg), folders of .exr, patterns, or names of frames (shot.%%04d.exr, "
        "shot.####.exr, 'shot.$F4.exr'); -: standard input",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help=f"for one stack a file: .exr, .pfm or a picture (.png .jpg .webp); for several a folder, or names such as "
        f"clean.%%04d.exr; -: standard output. Missing folders are created (default: STACK{RESULT_SUFFIX}.exr beside "
        "each stack)",
    )
    first = "; ".join(f"{name}: {method.summary}" for name, method in by_standing("use").items())
    parser.add_argument(
        "-m",
        "--method",
        default="auto",
        metavar="NAME",
        choices=arguments.Names(METHODS),
        help=f"auto: a good method for the layers of the file and the installed packages (default); {first}. For "
        f"special cases: {', '.join(by_standing('niche'))}. `ngpt info NAME` describes a method",
    )
    parser.add_argument("--alpha", help="weight of the noisy image in l2 and l1: a number, or auto")
    parser.add_argument("--weights", metavar="FILE", help="your own network: .onnx, .safetensors or .tza")
    parser.add_argument(
        "--device", help="device for networks: cpu (default), cuda, tensorrt, openvino, directml, coreml"
    )
    parser.add_argument(
        "--memory",
        type=int,
        metavar="MIB",
        help=f"memory limit for networks; larger images are computed in tiles (default: {MEMORY})",
    )
    parser.add_argument("--threads", type=int, metavar="N", help="number of threads (default: all cores)")
    arguments.add_options(parser, "method", "METHOD")
    parser.add_argument(
        "--error",
        action="store_true",
        help="also write the layer 'error', the standard error of each pixel; takes twice the time",
    )
    parser.add_argument(
        "--halves",
        nargs=2,
        metavar=("A", "B"),
        help="as --error, and compare the results of two stacks of half the samples each, such as the two that STACK "
        "was merged from, which also detects blotches; takes four times the time",
    )
    names = ", ".join(f"{pattern} ({renderer})" for renderer, pattern in lightgroups.PATTERNS.items())
    parser.add_argument(
        "--groups", action="store_true", help=f"also denoise light groups, so that they add up to the result: {names}"
    )
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME",
        help="also a light group of this name; * stands for any letters; may be repeated",
    )
    parser.add_argument(
        "--temporal",
        action="store_true",
        help="the stacks are the frames of one shot, with motion vectors: blend each frame with the frames before it, "
        "for less flicker. With -m wcv and frames from `ngpt render --dt`: also with the frames after it",
    )
    parser.add_argument(
        "--reduce",
        type=arguments.positive,
        default=1,
        metavar="K",
        help="for images rendered K times as large as wanted: denoise them so, and make one pixel of each K x K. 2, "
        "with a quarter of the samples, keeps edges best",
    )
    parser.add_argument(
        "--into",
        metavar="LAYER",
        help="layer that the result replaces beside the root R G B, such as Combined; root: none (default: the layer "
        "that the noisy image was read from, unless it is called noisy)",
    )
    parser.add_argument(
        "--wrap",
        action="store_true",
        help="the images are panoramas: their left and right borders are neighbours. Files with the attribute envmap "
        "need no --wrap",
    )
    parser.add_argument(
        "--ref",
        metavar="REF",
        help="reference image: print the error in the pixels that both have, as relMSE and as trimmed relMSE, which "
        "leaves out the worst 0.1 %% of the pixels",
    )
    arguments.add_files(parser)
    arguments.add_layers(parser)
    arguments.add_view(parser, "default: all views")
    add_look(parser)
    arguments.add_untrusted(parser)
    existing = parser.add_mutually_exclusive_group()
    arguments.add_force(existing)
    existing.add_argument(
        "--skip-existing", action="store_true", help="skip stacks whose results exist, to continue a folder"
    )
    arguments.add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if args.json and args.output == STREAM:
        raise NgptError("-o - and --json both want standard output; leave one out")
    if args.threads is not None:
        limit_threads(args.threads)
    with as_files(args.stacks, args.output) as (args.stacks, args.output):
        return denoise(args, console)


def denoise(args: argparse.Namespace, console: Console) -> int:
    pairs = output_paths(arguments.stack_files(args.stacks), args.output)
    files, options, reference = asked(args, pairs)
    # One stack has no progress to report, but a user who watches sees that it is being denoised.
    bar = console.progress("denoise", "frames") if len(pairs) > 1 or console.terminal else nullcontext(_unseen)
    frames = results(args, pairs, files, options, reference, console)
    reports = []
    with bar as progress, closing(frames):
        progress(0, len(pairs))
        for i, ((source, _), report) in enumerate(zip(pairs, frames, strict=True), 1):
            if isinstance(report, NgptError):
                console.error(report)
                report = {"input": str(source), "error": str(report)}
            else:
                console.say(f"[{i}/{len(pairs)}] {describe(report)}")
                if unknown := report.get("pixels without standard error"):
                    console.say(f"{source}: the error of {unknown} pixels is NaN, for their variances are not finite")
            reports.append(report)
            progress(i, len(pairs))
    if args.temporal and (hint := motion_hint(pairs, reports, args)):
        console.say(hint)
    # The result does not show that features went unrecognized.
    overlooked: dict = next((report for report in reports if report.get("proposed")), {"proposed": {}})
    for name, layer in overlooked["proposed"].items():
        console.say(
            f"{overlooked['input']}: '{layer}' looks like {name} and was not used; --layer {name}=\"{layer}\" takes it"
        )
    failed = sum("error" in report for report in reports)
    skipped = sum("skipped" in report for report in reports)
    if failed and len(pairs) > 1:
        console.error(f"{failed} of {len(pairs)} stacks were not reconstructed")
    if skipped:
        console.say(f"{skipped} of {len(pairs)} stacks were skipped: their results are there")
    if args.json:
        arguments.print_json({"ok": failed == 0, "files": reports})
    return 1 if failed else 0


def asked(
    args: argparse.Namespace, pairs: list[tuple[Path, Path]]
) -> tuple[dict[str, str], dict[str, Any], Reference | None]:
    """Files of further layers, the method's options, and the reference. Raises an error for requests that cannot be
    met.
    """
    files = arguments.given_files(args)
    if len(pairs) > 1 and (files or args.halves):
        of_one = f"--{next(iter(files))} belongs" if files else "--halves belong"
        raise WrongUse(f"{of_one} to one stack, and {len(pairs)} are given; denoise them one by one")
    args.error = args.error or bool(args.halves)
    if args.temporal:
        for option, given in (("--error", args.error), ("--groups", args.groups or args.group)):
            if given:
                raise WrongUse(f"--temporal and {option} cannot be combined; leave one out")
    names = ("alpha", "weights", "device", "memory")
    options = {name: getattr(args, name) for name in names if getattr(args, name) is not None} | dict(args.option)
    check_request(args.method, options)
    reference = Reference.read(args.ref, args.untrusted) if args.ref else None
    for _, target in pairs:
        if target.suffix.lower() != ".exr":
            check_picture(target, args)
        arguments.output_file(target, args)
    return files, options, reference


def results(
    args: argparse.Namespace,
    pairs: list[tuple[Path, Path]],
    files: dict[str, str],
    options: dict[str, Any],
    reference: Reference | None,
    console: Console,
) -> Any:
    """Makes and writes the result of each pair: an iterator over the report, or the error, of each."""
    missing = [i for i, (_, target) in enumerate(pairs) if not (args.skip_existing and finished(target))]
    windows = False
    if args.temporal and missing:
        windows, told = way([source for source, _ in pairs], dict(args.layer), args.method == "wcv" and not options)
        console.say(f"--temporal: {told}")
        for name in filter(is_shot, args.stacks):
            for remark in remarks(name, arguments.stack_files([name]), results=False):
                console.say(remark)
    # These results may exist, but later frames need their history.
    again = {target for _, target in (pairs if windows else pairs[: missing[-1]])} if args.temporal and missing else ()
    read = partial(read_frame, args=args, files=files, again=again)
    # If the disk is full, one of several frames is not kept elsewhere: the next call makes it again.
    write = partial(write_frame, args=args, keep=len(pairs) == 1)
    if windows:
        return windowed(pairs, read, write, reference)
    temporal: Any = defaultdict(Temporal) if args.temporal else None
    compute = partial(compute_frame, args=args, options=options, reference=reference, temporal=temporal)
    return overlapped(pairs, read, compute, write)


def _unseen(done: int, total: int) -> None:
    """Progress that is not shown."""


def read_frame(
    pair: tuple[Path, Path], args: argparse.Namespace, files: dict[str, str], again: Container[Path]
) -> Frame:
    """Reads a frame. ``again`` contains existing results to make again, because later frames build on them."""
    source, target = pair
    # Checked only now, because several machines may work on one folder.
    there = args.skip_existing and finished(target)
    if there and target.suffix.lower() == ".exr":
        _check_result(source, target, args)
    if there and target not in again:
        return Frame(source, target, None, there=True)
    cut = args.skip_existing and not there and target.exists()
    stacks = read_views(source, dict(args.layer), args.untrusted, files, args.view)
    stacks = [wrapping(stack) for stack in stacks] if args.wrap else stacks
    for stack in stacks if args.reduce > 1 else []:
        check_reducible(stack, args.reduce)
    first, *others = (Frame(source, target, stack, there=there, cut=cut) for stack in stacks)
    if others and (what := one_view_only(target, args, files)):
        raise NgptError(f"{source}: has several views, and {what}; choose one, as in --view {first.view}")
    return replace(first, others=tuple(others))


def _check_result(source: Path, target: Path, args: argparse.Namespace) -> None:
    """Raises NgptError if a result was made from another stack, or with settings that differ from the requested
    ones.
    """
    result, stack = first_attributes(target), first_attributes(source)
    asked: dict[str, Any] = {name: stack.get(name) for name in ("ngpt:spp", "ngpt:seed") if name in stack}
    asked[REDUCED] = args.reduce if args.reduce > 1 else None
    asked["ngpt:temporal"] = result.get("ngpt:temporal", "asked for") if args.temporal else None
    if args.method in METHODS and not args.weights:
        options = METHODS[args.method].options
        given = as_text(unusual(options, settings(f"method '{args.method}'", options, dict(args.option))))
        asked |= {"ngpt:method": args.method, "ngpt:options": given or None}
    for name, value in asked.items():
        if result.get(name) != value:
            what = name.removeprefix("ngpt:")
            raise NgptError(
                f"{target}: is another result: {what} {result.get(name, 'none')}, not {value or 'none'}; give another "
                "name, or --force in place of --skip-existing to replace it"
            )


def _halves(frame: Frame, args: argparse.Namespace) -> tuple[GradientStack, GradientStack] | None:
    """The two stacks of ``--halves``, of the view of this frame."""
    if not args.halves:
        return None
    one, other = (read(path, dict(args.layer), args.untrusted, view=frame.view or None) for path in args.halves)
    return one, other


def compute_frame(
    frame: Frame,
    args: argparse.Namespace,
    options: dict,
    reference: Reference | None,
    temporal: dict[str, Temporal] | None,
) -> Frame:
    """The frame with its result, and its other views with their results; ``temporal`` is the history of each view."""
    stack = frame.stack
    if stack is None:
        return frame
    others = tuple(compute_frame(other, args, options, None, temporal) for other in frame.others)
    groups = lightgroups.find(stack, args.group) if args.groups or args.group else {}
    if args.error:
        result = reconstruct_with_error(stack, args.method, halves=_halves(frame, args), **options)
    else:
        result = reconstruct(stack, args.method, **options)
    over_time: dict[str, Any] = {}
    told: dict[str, Any] = {}
    if temporal is not None:
        begun, history = time.perf_counter(), temporal[frame.view]
        image = history.next(stack, result.image)
        result = replace(result, image=image, seconds=result.seconds + time.perf_counter() - begun)
        over_time = {"ngpt:temporal": "history", "ngpt:history": history.share}
        told = {"why no history": history.reason} if history.reason else {}
        if isinstance(history.corrections, Network):
            over_time["ngpt:historyWeights"] = str(identify(history.corrections.path))
    if reference is not None:
        image, place = smaller(result.image, stack.place, args.reduce)
        told |= reference.errors(
            image, GradientStack({"primal": image}, stack.attributes, path=stack.path, place=place)
        )
    if groups:
        parts = lightgroups.denoised(stack, groups, result.image, args.method, **options)
        stack = lightgroups.with_groups(stack, parts)
        told |= {"groups": list(groups)}
    if result.error is not None:
        stack = stack.replace(error=result.error)
    return replace(frame, stack=stack, result=result, others=others, over_time=over_time, told=told)
