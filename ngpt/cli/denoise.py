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
from ngpt.cli.denoise_files import Frame, View, describe, write_frame
from ngpt.cli.denoise_request import DenoiseRequest, request_of
from ngpt.cli.denoise_shot import choose_blending, motion_hint, option_of_one_view, windowed
from ngpt.cli.picture import add_look
from ngpt.cli.streams import STREAM, as_files
from ngpt.errors import NgptError
from ngpt.io.exr import read, read_views
from ngpt.io.foreign.files import first_attributes
from ngpt.io.frames import RESULT_SUFFIX, is_shot, remarks
from ngpt.io.reduced import REDUCED, check_reducible
from ngpt.io.whole import finished
from ngpt.methods import METHODS, by_standing, reconstruct
from ngpt.network.identity import identify
from ngpt.network.run_onnx import MEMORY
from ngpt.options import as_text, settings, unusual
from ngpt.panorama import wrapping
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import CorrectionNetwork
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
        help="for one stack a file (.exr .pfm .png .jpg .webp), for several a folder, or names as clean.%%04d.exr; -: "
        f"standard output. Missing folders are made (default: STACK{RESULT_SUFFIX}.exr beside each stack)",
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
    parser.add_argument("--device", help="for networks: cpu (default), cuda, tensorrt, openvino, directml or coreml")
    what = f"memory limit for networks; larger images are computed in tiles (default: {MEMORY})"
    parser.add_argument("--memory", type=int, metavar="MIB", help=what)
    parser.add_argument("--threads", type=int, metavar="N", help="number of threads (default: all cores)")
    arguments.add_options(parser, "method", "METHOD")
    what = "also write the layer 'error', the standard error of each pixel; takes twice the time"
    parser.add_argument("--error", action="store_true", help=what)
    parser.add_argument(
        "--halves",
        nargs=2,
        metavar=("A", "B"),
        help="like --error, but also compare the results of two stacks with half of the samples each, such as those "
        "that STACK was merged from, to detect blotches too; takes four times the time",
    )
    names = ", ".join(f"{pattern} ({renderer})" for renderer, pattern in lightgroups.PATTERNS.items())
    what = f"also denoise light groups, so that they add up to the result: {names}"
    parser.add_argument("--groups", action="store_true", help=what)
    what = "also a light group of this name; * stands for any letters; may be repeated"
    parser.add_argument("--group", action="append", default=[], metavar="NAME", help=what)
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
        help="make one pixel of each K x K after denoising, for images rendered K times as large as needed. 2, with a "
        "quarter of the samples, keeps edges best",
    )
    parser.add_argument(
        "--into",
        metavar="LAYER",
        help="layer that the result replaces beside the root R G B, such as Combined; root: none (default: the layer "
        "that the noisy image was read from, unless it is called noisy)",
    )
    what = "the images are panoramas, whose left and right borders are neighbours; not needed for files with envmap"
    parser.add_argument("--wrap", action="store_true", help=what)
    what = "reference image: print relMSE in the pixels that both have, and relMSE without the worst 0.1 %% of these"
    parser.add_argument("--ref", metavar="REF", help=what)
    arguments.add_files(parser)
    arguments.add_layers(parser)
    arguments.add_view(parser, "default: all views")
    add_look(parser)
    arguments.add_untrusted(parser)
    existing = parser.add_mutually_exclusive_group()
    arguments.add_force(existing)
    existing.add_argument("--skip-existing", action="store_true", help="skip stacks with results, to continue a folder")
    arguments.add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if args.json and args.output == STREAM:
        raise NgptError("-o - and --json both want standard output; leave one out")
    if args.threads is not None:
        limit_threads(args.threads)
    with as_files(args.stacks, args.output) as (args.stacks, args.output):
        return denoise(request_of(args), args.json, console)


def denoise(request: DenoiseRequest, as_json: bool, console: Console) -> int:
    """Makes and writes all results, and reports them as lines or as JSON. Returns the exit status."""
    pairs, reports = request.pairs, []
    # A single stack has no progress to report. On a terminal, a bar still shows that the stack is being denoised.
    shows_bar = len(pairs) > 1 or console.terminal
    bar = console.progress("denoise", "frames") if shows_bar else nullcontext(lambda done, total: None)
    with bar as progress, closing(results(request, console)) as outcomes:
        progress(0, len(pairs))
        for i, ((source, _), report) in enumerate(zip(pairs, outcomes, strict=True), 1):
            if isinstance(report, NgptError):
                console.error(report)
                report = {"input": str(source), "error": str(report)}
            else:
                console.say(f"[{i}/{len(pairs)}] {describe(report)}")
                if unknown := report.get("pixels without standard error"):
                    console.say(f"{source}: the error of {unknown} pixels is NaN, for their variances are not finite")
            reports.append(report)
            progress(i, len(pairs))
    if request.temporal and (hint := motion_hint(request, reports)):
        console.say(hint)
    # Users cannot see in the result that features were not recognized, so a message tells them.
    overlooked: dict = next((report for report in reports if report.get("proposed")), {"proposed": {}})
    for name, layer in overlooked["proposed"].items():
        hint = f"'{layer}' looks like {name} and was not used; --layer {name}=\"{layer}\" takes it"
        console.say(f"{overlooked['input']}: {hint}")
    failed = sum("error" in report for report in reports)
    skipped = sum("skipped" in report for report in reports)
    if failed and len(pairs) > 1:
        console.error(f"{failed} of {len(pairs)} stacks were not reconstructed")
    if skipped:
        console.say(f"{skipped} of {len(pairs)} stacks were skipped: their results are there")
    if as_json:
        arguments.print_json({"ok": failed == 0, "files": reports})
    return 1 if failed else 0


def results(request: DenoiseRequest, console: Console) -> Any:
    """Returns a generator that makes and writes the result of each pair, and yields its report or its error."""
    pairs, again = request.pairs, set[Path]()
    missing = [i for i, (_, target) in enumerate(pairs) if not (request.skip_existing and finished(target))]
    windows = False
    if request.temporal and missing:
        windows, blending = choose_blending(request)
        console.say(f"--temporal: {blending}")
        for name in filter(is_shot, request.stacks):
            for remark in remarks(name, arguments.stack_files([name]), results=False):
                console.say(remark)
        # These frames are read even if their results exist, because other frames need them.
        again = {target for _, target in (pairs if windows else pairs[: missing[-1]])}
    read = partial(read_frame, request=request, again=again)
    write = partial(write_frame, request=request)
    if windows:
        return windowed(request, read, write)
    histories: Any = defaultdict(Temporal) if request.temporal else None
    return overlapped(pairs, read, partial(compute_frame, request=request, histories=histories), write)


def read_frame(pair: tuple[Path, Path], request: DenoiseRequest, again: Container[Path]) -> Frame:
    """Reads a frame.

    If the result of the frame exists, the frame is only read if ``again`` has the result: then other frames need it.
    """
    source, target = pair
    # Whether the result exists is checked only now, because several machines may work on one folder.
    exists = request.skip_existing and finished(target)
    if exists and target.suffix.lower() == ".exr":
        _check_result(source, target, request)
    if exists and target not in again:
        return Frame(source, target, exists=True)
    stacks = read_views(source, request.layer, request.untrusted, request.files, request.view)
    stacks = [wrapping(stack) for stack in stacks] if request.wrap else stacks
    for stack in stacks if request.reduce > 1 else []:
        check_reducible(stack, request.reduce)
    views = tuple(View(stack) for stack in stacks)
    if len(views) > 1 and (what := option_of_one_view(target, request)):
        raise NgptError(f"{source}: has several views, and {what} is of one; choose one, as in --view {views[0].name}")
    return Frame(source, target, views, exists, request.skip_existing and not exists and target.exists())


def _check_result(source: Path, target: Path, request: DenoiseRequest) -> None:
    """Raises NgptError if a result was made from another stack, or with other settings than the requested ones."""
    result, stack = first_attributes(target), first_attributes(source)
    expected: dict[str, Any] = {name: stack.get(name) for name in ("ngpt:spp", "ngpt:seed") if name in stack}
    expected[REDUCED] = request.reduce if request.reduce > 1 else None
    expected["ngpt:temporal"] = result.get("ngpt:temporal", "asked for") if request.temporal else None
    if request.method in METHODS and "weights" not in request.options:
        options = METHODS[request.method].options
        given = as_text(unusual(options, settings(f"method '{request.method}'", options, request.options)))
        expected |= {"ngpt:method": request.method, "ngpt:options": given or None}
    for name, value in expected.items():
        if result.get(name) != value:
            what = name.removeprefix("ngpt:")
            raise NgptError(
                f"{target}: is another result: {what} {result.get(name, 'none')}, not {value or 'none'}; give another "
                "name, or --force in place of --skip-existing to replace it"
            )


def compute_frame(frame: Frame, request: DenoiseRequest, histories: dict[str, Temporal] | None) -> Frame:
    """The frame with the results of all its views; ``histories`` has the history of each view by its name."""
    views = [compute_view(view, request, None if histories is None else histories[view.name]) for view in frame.views]
    return replace(frame, views=tuple(views))


def compute_view(view: View, request: DenoiseRequest, history: Temporal | None) -> View:
    """The view with its result, blended with its ``history`` if there is one."""
    stack, method, options = view.stack, request.method, request.options
    groups = {} if request.groups is None else lightgroups.find(stack, request.groups)
    over_time, notes = dict[str, Any](), dict[str, Any]()
    if request.error:
        halves = [read(path, request.layer, request.untrusted, view=view.name or None) for path in request.halves or ()]
        result = reconstruct_with_error(stack, method, halves=(halves[0], halves[1]) if halves else None, **options)
    else:
        result = reconstruct(stack, method, **options)
    if history is not None:
        begun = time.perf_counter()
        image = history.next(stack, result.image)
        result = replace(result, image=image, seconds=result.seconds + time.perf_counter() - begun)
        over_time = {"ngpt:temporal": "history", "ngpt:history": history.share}
        notes = {"why no history": history.reason} if history.reason else {}
        if isinstance(history.corrections, CorrectionNetwork):
            over_time["ngpt:historyWeights"] = str(identify(history.corrections.path))
    if request.reference is not None:
        notes |= request.reference.errors(result.image, stack, request.reduce)
    if groups:
        parts = lightgroups.denoised(stack, groups, result.image, method, **options)
        stack = lightgroups.with_groups(stack, parts)
        notes |= {"groups": list(groups)}
    if result.error is not None:
        stack = stack.replace(error=result.error)
    return View(stack, result, over_time, notes)
