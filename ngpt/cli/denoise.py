"""``ngpt denoise``: from gradient stacks to images."""

import argparse
import os
from pathlib import Path

import numpy as np

from ngpt.cli.arguments import (
    RESULT_SUFFIX,
    add_files,
    add_force,
    add_json,
    add_layers,
    add_untrusted,
    assignment,
    given_files,
    print_json,
    stack_files,
)
from ngpt.errors import NgptError
from ngpt.io.exr import read, read_image, write
from ngpt.measure.metrics import compare
from ngpt.methods import METHODS, reconstruct
from ngpt.network.run_onnx import MEMORY
from ngpt.system.console import Console
from ngpt.system.files import check_output
from ngpt.version import __version__

# The options of methods that are numbers; they may be "auto" as well.
NUMBERS = {
    name for method in METHODS.values() for name, value in method.options.items() if isinstance(value, int | float)
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    methods = "; ".join(f"{name}: {method.summary}" for name, method in METHODS.items())
    parser.add_argument("stacks", nargs="+", metavar="STACK", help=".exr files, folders of them, or patterns")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        help=f"file for one stack, folder for several (default: STACK{RESULT_SUFFIX}.exr beside each)",
    )
    parser.add_argument("-m", "--method", default="auto", choices=["auto", *METHODS], help=f"default: auto. {methods}")
    parser.add_argument("--alpha", type=alpha, help="weight of the primal image in l2 and l1: a number, or auto")
    parser.add_argument("--weights", metavar="FILE", help="a network (.onnx, .safetensors) instead of the one shipped")
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
        help=f"an option of the method; may be repeated. With their defaults: {_options()}",
    )
    parser.add_argument("--ref", metavar="REF", help="reference image: report the error against it")
    add_files(parser)
    add_layers(parser)
    add_untrusted(parser)
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    files = given_files(args)
    pairs = output_paths(stack_files(args.stacks), args.output)
    if files and len(pairs) > 1:
        raise NgptError(
            f"--{next(iter(files))} belongs to one stack, and {len(pairs)} are given; denoise them one by one"
        )
    for _, target in pairs:
        check_output(target, args.force)
    reference = read_image(args.ref, args.untrusted) if args.ref else None
    options = {
        name: value for name in ("alpha", "weights", "device", "memory") if (value := getattr(args, name)) is not None
    }
    options |= {name: number(text) if name in NUMBERS else text for name, text in args.option}
    reports = []
    for i, (source, target) in enumerate(pairs, 1):
        try:
            report = denoise_file(source, target, args, files, options, reference)
            console.say(f"[{i}/{len(pairs)}] {describe(report)}")
        except NgptError as error:
            report = {"input": str(source), "error": str(error)}
            console.error(error)
        reports.append(report)
    failed = sum("error" in report for report in reports)
    if failed and len(pairs) > 1:
        console.error(f"{failed} of {len(pairs)} stacks were not reconstructed")
    if args.json:
        print_json({"ok": failed == 0, "files": reports})
    return 1 if failed else 0


def denoise_file(
    source: Path, target: Path, args, files: dict[str, str], options: dict, reference: np.ndarray | None
) -> dict:
    """Reads, reconstructs and writes one stack; returns what there is to report."""
    stack = read(source, dict(args.layer), args.untrusted, files)
    result = reconstruct(stack, args.method, **options)
    report = {
        "input": str(source),
        "output": str(target),
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
    }
    if reference is not None:
        report["metrics"] = compare(result.image, reference)
    write(target, result.image, like=stack, overwrite=args.force, attributes=result.attributes)
    return report


def alpha(text: str) -> float | str:
    """A number, or ``auto``."""
    return text if text == "auto" else float(text)


def number(text: str) -> int | float | str:
    """A number where it is one; the method says what else it takes."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _options() -> str:
    """The options of methods that have no argument of their own: "oidn: auxiliary=prefiltered, quality=high"."""
    own = {"alpha", "weights", "device", "memory"}
    found = {
        name: ", ".join(f"{option}={value}" for option, value in method.options.items() if option not in own)
        for name, method in METHODS.items()
        if not method.variant
    }
    return "; ".join(f"{name}: {options}" for name, options in found.items() if options)


def describe(report: dict) -> str:
    """One line about one file."""
    text = f"{report['input']} -> {report['output']}: {report['method']}"
    if report["weights"] and report["method"] not in METHODS:
        text += f", sha256 {report['weights']['sha256'][:12]}"
    text += f", {report['seconds']:.2f} s"
    if report["repaired"] or report["untrusted"]:
        text += f", repaired {report['repaired']} pixels, left out {report['untrusted']} gradients"
    if "metrics" in report:
        text += f", relMSE {report['metrics']['relMSE']:.5g}"
    return text


def output_paths(sources: list[Path], output: str | None) -> list[tuple[Path, Path]]:
    """Where the result of each source goes; makes the output folder if there is to be one."""
    if output is None:
        targets = [path.with_name(f"{path.stem}{RESULT_SUFFIX}.exr") for path in sources]
    elif len(sources) == 1 and not Path(output).is_dir() and not output.endswith(("/", os.sep)):
        targets = [Path(output)]
    else:
        folder = Path(output)
        if folder.exists() and not folder.is_dir():
            raise NgptError(f"{folder}: is a file; the results of {len(sources)} stacks need a folder")
        targets = [folder / path.name for path in sources]
        repeated = next((t for i, t in enumerate(targets) if t in targets[:i]), None)
        if repeated:
            raise NgptError(f"{repeated}: would be the result of two stacks of that name; denoise them one by one")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise NgptError(f"{folder}: cannot be made: {error.strerror}") from error
    return list(zip(sources, targets, strict=True))
