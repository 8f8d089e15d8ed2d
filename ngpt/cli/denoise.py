"""``ngpt denoise``: from gradient stacks to images."""

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Container, Mapping
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ngpt.api import lightgroups
from ngpt.api.uncertainty import reconstruct_with_error
from ngpt.cli.arguments import (
    Names,
    add_files,
    add_force,
    add_json,
    add_layers,
    add_untrusted,
    add_view,
    assignment,
    given_files,
    print_json,
    stack_files,
)
from ngpt.cli.denoise_shot import motion_hint, one_view_only, way, windowed
from ngpt.cli.picture import add_look, check_picture, exposed, in_picture
from ngpt.cli.reference import Errors, Reference
from ngpt.cli.streams import STREAM, as_files
from ngpt.errors import NgptError, WrongUse
from ngpt.io.exr import read_views, write
from ngpt.io.frames import RESULT_SUFFIX, is_shot, remarks
from ngpt.io.openexr import read_header
from ngpt.io.primaries import converted, to_rec709
from ngpt.io.whole import finished
from ngpt.methods import METHODS, Result, by_standing, reconstruct
from ngpt.network.identity import identify
from ngpt.network.run_onnx import MEMORY
from ngpt.options import as_text, settings, unusual
from ngpt.report.pictures import write_picture
from ngpt.report.transforms import shown
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import Network
from ngpt.stack import GradientStack
from ngpt.system.console import Console
from ngpt.system.files import check_output, save
from ngpt.system.pipeline import overlapped
from ngpt.version import __version__


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "stacks", nargs="+", metavar="STACK", help=".exr files, folders of them, or patterns; -: standard input"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help=f"file for one stack, folder for several; folders are made (default: STACK{RESULT_SUFFIX}.exr beside "
        "each); of one stack a picture too (.png .jpg .webp); -: standard output",
    )
    first = "; ".join(f"{name}: {method.summary}" for name, method in by_standing("use").items())
    parser.add_argument(
        "-m",
        "--method",
        default="auto",
        metavar="NAME",
        choices=Names(METHODS),
        help=f"auto: the best that layers and machine allow (default); {first}; for some stacks: "
        f"{', '.join(by_standing('niche'))}. See `ngpt info`",
    )
    parser.add_argument("--alpha", help="weight of the primal image in l2 and l1: a number, or auto")
    parser.add_argument("--weights", metavar="FILE", help="a network of your own: .onnx, .safetensors, .tza")
    parser.add_argument(
        "--device", help="where networks run: cpu (default), cuda, tensorrt, openvino, directml, coreml"
    )
    parser.add_argument(
        "--memory", type=int, metavar="MIB", help=f"that networks may use (default: {MEMORY}); in tiles"
    )
    parser.add_argument(
        "-O",
        "--option",
        action="append",
        default=[],
        type=assignment,
        metavar="NAME=VALUE",
        help="an option of the method; may be repeated. See `ngpt info METHOD`",
    )
    parser.add_argument(
        "--error",
        action="store_true",
        help="write a layer 'error' too: the standard error of each pixel; twice the time",
    )
    names = ", ".join(f"{pattern} ({renderer})" for renderer, pattern in lightgroups.PATTERNS.items())
    parser.add_argument(
        "--groups", action="store_true", help=f"denoise light groups too, so that they add up to the result: {names}"
    )
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME",
        help="a light group of another name, * for any letters; may be repeated",
    )
    parser.add_argument(
        "--temporal",
        action="store_true",
        help="the stacks are frames of one shot, in order, with motion vectors: less flicker by the frames before; "
        "with -m wcv, and differences in time in all of them (`ngpt render --dt`), by those after too",
    )
    parser.add_argument("--ref", metavar="REF", help="reference image: report the error in the pixels that both have")
    add_files(parser)
    add_layers(parser)
    add_view(parser, "default: all of them")
    add_look(parser)
    add_untrusted(parser)
    existing = parser.add_mutually_exclusive_group()
    add_force(existing)
    existing.add_argument(
        "--skip-existing", action="store_true", help="leave stacks out whose results are there: goes on with a folder"
    )
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if args.json and args.output == STREAM:
        raise NgptError("-o - and --json both want standard output; leave one out")
    with as_files(args.stacks, args.output) as (args.stacks, args.output):
        return denoise(args, console)


def denoise(args: argparse.Namespace, console: Console) -> int:
    files = given_files(args)
    pairs = output_paths(stack_files(args.stacks), args.output)
    if files and len(pairs) > 1:
        raise WrongUse(
            f"--{next(iter(files))} belongs to one stack, and {len(pairs)} are given; denoise them one by one"
        )
    for _, target in pairs:
        check_output(target, args.force or args.skip_existing)
        if target.suffix.lower() != ".exr":
            check_picture(target, args)
    if args.temporal:
        for option, given in (("--error", args.error), ("--groups", args.groups or args.group)):
            if given:
                raise WrongUse(f"--temporal goes without {option}: history has no {option[2:]}; leave one out")
    # Their results are there, but later frames are made of them.
    missing = [i for i, (_, target) in enumerate(pairs) if not finished(target)] if args.temporal else []
    again = {target for _, target in pairs[: missing[-1]]} if missing else set()
    reference = Reference.read(args.ref, args.untrusted) if args.ref else None
    options = {
        name: value for name in ("alpha", "weights", "device", "memory") if (value := getattr(args, name)) is not None
    }
    options |= dict(args.option)
    # One stack has no progress to tell, but somebody who looks on sees that it is at work.
    bar = console.progress("denoise", "frames") if len(pairs) > 1 or console.terminal else nullcontext(_unseen)
    overwrite = partial(
        write_frame,
        overwrite=args.force,
        transform=args.transform,
        exposure=args.exposure,
        # Of a folder, whose disk may be full, the next call makes again what is missing.
        keep=len(pairs) == 1,
    )
    frames: Any
    windows = False
    if args.temporal and not all(args.skip_existing and finished(target) for _, target in pairs):
        by_wcv = args.method == "wcv" and not options
        windows, told = way([source for source, _ in pairs], dict(args.layer), by_wcv)
        console.say(f"--temporal: {told}")
        for name in filter(is_shot, args.stacks):
            for remark in remarks(name, stack_files([name]), results=False):
                console.say(remark)
    if windows:
        everything = {target for _, target in pairs}
        frames = windowed(pairs, partial(read_frame, args=args, files=files, again=everything), overwrite, reference)
    else:
        frames = overlapped(
            pairs,
            partial(read_frame, args=args, files=files, again=again),
            partial(
                compute_frame,
                args=args,
                options=options,
                reference=reference,
                temporal=defaultdict(Temporal) if args.temporal else None,
            ),
            overwrite,
        )
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
    failed = sum("error" in report for report in reports)
    skipped = sum("skipped" in report for report in reports)
    if failed and len(pairs) > 1:
        console.error(f"{failed} of {len(pairs)} stacks were not reconstructed")
    if skipped:
        console.say(f"{skipped} of {len(pairs)} stacks were skipped: their results are there")
    if args.json:
        print_json({"ok": failed == 0, "files": reports})
    return 1 if failed else 0


def _unseen(done: int, total: int) -> None:
    """Progress that nobody is shown."""


class Frame(NamedTuple):
    """A stack on its way from its file to that of its result; with ``there`` its result was there already.

    ``cut`` says that a file is in its place that is not whole.
    ``over_time`` is what other frames were to the result, as header attributes; ``reason`` why they were nothing.
    ``others`` are the other views of the file.
    """

    source: Path
    target: Path
    stack: GradientStack | None
    result: Result | None = None
    errors: Errors | None = None
    groups: tuple[str, ...] = ()
    there: bool = False
    cut: bool = False
    over_time: Mapping[str, Any] = {}
    reason: str = ""
    others: tuple["Frame", ...] = ()

    @property
    def view(self) -> str:
        """The name of the view that it is of; "" in a file without views."""
        return self.stack.source.view.name if self.stack is not None and self.stack.source is not None else ""


def read_frame(
    pair: tuple[Path, Path], args: argparse.Namespace, files: dict[str, str], again: Container[Path]
) -> Frame:
    """``again``: results that are made again where they are there, since others build on them."""
    source, target = pair
    # Only now, for several machines may be at work on one folder.
    there = args.skip_existing and finished(target)
    if there and target.suffix.lower() == ".exr":
        _check_result(source, target, args)
    if there and target not in again:
        return Frame(source, target, None, there=True)
    cut = args.skip_existing and not there and target.exists()
    stacks = read_views(source, dict(args.layer), args.untrusted, files, args.view)
    first, *others = (Frame(source, target, stack, there=there, cut=cut) for stack in stacks)
    if others and (what := one_view_only(target, args, files)):
        raise NgptError(f"{source}: has several views, and {what}; choose one, as in --view {first.view}")
    return first._replace(others=tuple(others))


def _check_result(source: Path, target: Path, args: argparse.Namespace) -> None:
    """Raises NgptError where a result is not that of this stack by what is asked for."""
    (result, _), (stack, _) = read_header(target), read_header(source)
    asked: dict[str, Any] = {name: stack.get(name) for name in ("ngpt:spp", "ngpt:seed") if name in stack}
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


def compute_frame(
    frame: Frame,
    args: argparse.Namespace,
    options: dict,
    reference: Reference | None,
    temporal: dict[str, Temporal] | None,
) -> Frame:
    """The frame with its result, and those of its other views; ``temporal`` is the history of each view."""
    stack = frame.stack
    if stack is None:
        return frame
    others = tuple(compute_frame(other, args, options, None, temporal) for other in frame.others)
    groups = lightgroups.find(stack, args.group) if args.groups or args.group else {}
    result = (reconstruct_with_error if args.error else reconstruct)(stack, args.method, **options)
    over_time, reason = {}, ""
    if temporal is not None:
        begun, history = time.perf_counter(), temporal[frame.view]
        image = history.next(stack, result.image)
        result = replace(result, image=image, seconds=result.seconds + time.perf_counter() - begun)
        over_time, reason = {"ngpt:temporal": "history", "ngpt:history": history.share}, history.reason
        if isinstance(history.corrections, Network):
            over_time["ngpt:historyWeights"] = str(identify(history.corrections.path))
    errors = reference.errors(result.image, stack) if reference is not None else None
    if groups:
        parts = lightgroups.denoised(stack, groups, result.image, args.method, **options)
        stack = lightgroups.with_groups(stack, parts)
    if result.error is not None:
        stack = stack.replace(error=result.error)
    frame = frame._replace(stack=stack, result=result, errors=errors, groups=tuple(groups), others=others)
    return frame._replace(over_time=over_time, reason=reason)


def write_frame(
    frame: Frame, overwrite: bool, transform: str = "standard", exposure: float | str = 0.0, keep: bool = False
) -> dict:
    """Writes the result, with ``keep`` elsewhere where it must, and returns what there is to report."""
    source, target, stack, result, errors, groups, there, cut, over_time, reason, others = frame
    report: dict[str, Any] = {"input": str(source), "output": str(target)}
    if there or stack is None or result is None:
        return report | {"skipped": True}
    made = {**result.attributes, **over_time}

    def save_to(path: Path, overwrite: bool) -> None:
        if path.suffix.lower() == ".exr":
            views = [(one.result.image, one.stack) for one in (frame, *others) if one.result and one.stack]
            write(path, [image for image, _ in views], [of for _, of in views], overwrite, made)
        else:
            light = in_picture(converted(result.image, to_rec709(stack.attributes)), stack.place)
            write_picture(path, shown(light, transform, exposed(exposure, light)), overwrite)

    if keep:
        save(target, save_to, overwrite or cut)
    else:
        save_to(target, overwrite or cut)
    report |= {
        "method": result.method,
        "weights": {"file": result.weights.file, "sha256": result.weights.sha256} if result.weights else None,
        "options": result.options,
        "estimated": list(result.estimated),
        "version": __version__,
        "seconds": result.seconds,
        "width": stack.width,
        "height": stack.height,
        "repaired": result.repaired,
        "untrusted": result.untrusted,
        "standard error": result.error is not None,
        "groups": list(groups),
    }
    if result.error is not None:
        report["pixels without standard error"] = int(np.isnan(result.error).any(axis=-1).sum())
    report |= {"views": [one.view for one in (frame, *others)]} if frame.view else {}
    report |= {"why no history": reason} if reason else {}
    report |= {"in place of": "a file that was not whole"} if cut else {}
    report |= {name: over_time[f"ngpt:{name}"] for name in ("temporal", "history") if f"ngpt:{name}" in over_time}
    if errors is not None:
        report |= {"metrics": errors.metrics} | ({"compared": errors.part} if errors.part else {})
    return report


def describe(report: dict) -> str:
    """One line about one file."""
    if "skipped" in report:
        return f"{report['input']} -> {report['output']}: skipped, exists already"
    text = f"{report['input']} -> {report['output']}: {report['method']}"
    if report["weights"] and report["method"] not in METHODS:
        text += f", sha256 {report['weights']['sha256'][:12]}"
    text += f", {report['seconds']:.2f} s"
    if report.get("views"):
        text += f", views {', '.join(report['views'])}"
    if report["repaired"]:
        text += f", repaired {report['repaired']} pixels"
    if report["untrusted"]:
        text += f", left out {report['untrusted']} gradients"
    if "in place of" in report:
        text += f", in place of {report['in place of']}"
    if "history" in report:
        text += f", {report['history']:.0%} history"
        text += f" ({report['why no history']})" if "why no history" in report else ""
    if report["groups"]:
        text += f", light groups {', '.join(report['groups'])}"
    if "metrics" in report:
        text += f", relMSE {report['metrics']['relMSE']:.5g}"
        text += f" of the pixels that both have: {report['compared']}" if "compared" in report else ""
    return text


def output_paths(sources: list[Path], output: str | None) -> list[tuple[Path, Path]]:
    """Where the result of each source goes; makes the output folder where there is none."""
    if output is None:
        targets = [path.with_name(f"{path.stem}{RESULT_SUFFIX}.exr") for path in sources]
    elif len(sources) == 1 and Path(output).suffix and not Path(output).is_dir() and not output.endswith(("/", os.sep)):
        targets = [Path(output)]
    else:
        folder = Path(output)
        named_file = folder.suffix.lower() == ".exr" and not output.endswith(("/", os.sep))
        if not folder.is_dir() and (folder.exists() or named_file):
            kind = "is a file" if folder.exists() else "is the name of a file"
            raise WrongUse(f"{folder}: {kind}; the results of {len(sources)} stacks need a folder")
        targets = [folder / path.name for path in sources]
        repeated = next((t for i, t in enumerate(targets) if t in targets[:i]), None)
        if repeated:
            raise WrongUse(f"{repeated}: would be the result of two stacks of that name; denoise them one by one")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise NgptError(f"{folder}: cannot be made: {error.strerror}") from error
    return list(zip(sources, targets, strict=True))
