"""``ngpt info``: describes a file, a scene, a method or a sampler."""

import argparse
import shutil
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.cli.arguments import add_json, add_layers, add_untrusted, add_view, assignment, print_json
from ngpt.cli.streams import standard_input
from ngpt.errors import NgptError, WrongUse
from ngpt.image.notebook import value_range
from ngpt.io.aliases import format_aliases
from ngpt.io.exr import pass_through, read, views_in
from ngpt.io.resolution import layers_held, propose
from ngpt.layers import LAYERS
from ngpt.merging import DIAGNOSTICS, REQUEST
from ngpt.methods import METHODS, by_standing, choose
from ngpt.network.describe import SUFFIXES as NETWORKS
from ngpt.network.describe import describe
from ngpt.shared import CUT, TAILS, noise_of_light
from ngpt.stack import GradientStack
from ngpt.system.console import Console, tell
from ngpt.system.install import BROUGHT, study
from ngpt.system.parts import find_renderer
from ngpt.system.records import parse_json
from ngpt.training.dataset import summary
from ngpt.training.run_summary import is_run
from ngpt.training.run_summary import summary as run_summary
from ngpt.version import __version__

# The most characters of an attribute that are printed: a Cryptomatte manifest may have a million
_LETTERS = 200
# Layers that stacks lack for a good reason
_OPTIONAL = ("error", "motion", "samples", "shared", "dt", "dt_var")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    kinds = "image (-: standard input), weights, training set, training run, scene, method or sampler"
    parser.add_argument("file", nargs="?", metavar="FILE", help=kinds)
    parser.add_argument("--aliases", action="store_true", help="print the names that other renderers give to layers")
    parser.add_argument(
        "-D", dest="define", action="append", default=[], type=assignment, metavar="NAME=VALUE", help="scene parameter"
    )
    add_layers(parser)
    add_view(parser, "default: the first")
    add_untrusted(parser)
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if args.aliases:
        print(format_aliases())
        return 0
    if args.file is None:
        show(overview(), args.json)
        return 0
    with standard_input([args.file]) as (args.file,):
        return describe_named(args, console)


def describe_named(args: argparse.Namespace, console: Console) -> int:
    """Prints the description of a file, a folder or a name; returns the exit status."""
    path = Path(args.file)
    if is_run(path):
        show(run_summary(path), args.json)
    elif path.is_dir():
        report = summary(path)
        show(report, args.json)
        return 1 if report["problems"] else 0
    elif path.suffix.lower() in NETWORKS and path.exists():
        show(describe(args.file), args.json)
    elif path.suffix.lower() == ".xml" or not path.exists():
        show(other(args.file, dict(args.define)), args.json)
    else:
        return file(args, console)
    return 0


def file(args: argparse.Namespace, console: Console) -> int:
    """Prints the description of an image file, and returns the exit status.

    If the file is not a stack, prints the error and the layers that the file holds.
    """
    views = views_in(args.file)
    names = {"views": [view.name for view in views]} if len(views) > 1 else {}
    try:
        report = stack(read(args.file, dict(args.layer), args.untrusted, view=args.view))
    except NgptError as error:
        console.error(error)
        held = {f"layers of {view.name}" if names else "layers": layers_held(view.parts) for view in views}
        show({"file": args.file} | names | held, args.json)
        return 1
    show(report | names, args.json)
    return 0


def overview() -> dict:
    """The version, the methods by their standing, and the renderer's samplers and scenes."""
    titles = {"methods": "use", "methods for some stacks": "niche", "methods to compare with": "study"}
    METHODS.load()
    report: dict[str, Any] = {"version": __version__}
    for title, standing in titles.items():
        report[title] = {name: method.missing() or method.summary for name, method in by_standing(standing).items()}
    try:
        return report | find_renderer().overview()
    except NgptError as error:
        return report | {"rendering": f"not available: {error}"}


def method(name: str) -> dict:
    """The description of a method; an empty dictionary if no method has that name."""
    if name not in METHODS:
        return {}
    entry = METHODS[name]
    report = {"method": name, "summary": entry.summary, "standing": entry.standing, "needs": entry.needs}
    report |= {"uses": entry.uses} if entry.uses else {}
    return report | {"options": {option: str(value) for option, value in entry.options.items()}}


def other(name: str, parameters: dict[str, str]) -> dict:
    """The description of a method, a sampler or a scene; for a scene, also how it would be rendered.

    Raises NgptError for a name that is none of these.
    """
    if Path(name).suffix.lower() in (".exr", *NETWORKS):
        raise NgptError(f"{name}: not found; check the name")
    found = {} if Path(name).exists() else method(name)
    try:
        renderer = find_renderer()
    except NgptError:
        if found:
            return found
        raise
    if not Path(name).exists():
        found |= renderer.describe_sampler(name)
    if found:
        return found
    if line := next(filter(None, (study(what, name) for what in BROUGHT)), ""):
        raise WrongUse(line)
    return {"scene": name} | renderer.inspect(name, parameters)


def stack(stack: GradientStack) -> dict:
    """The description of a stack that was read from a file: its layers, usable methods and header."""
    parts, resolution = stack.source.image.parts, stack.source.resolution
    further = pass_through(stack)
    METHODS.load()
    rates = {name: channel for name, channel in further.items() if name.startswith(DIAGNOSTICS)}
    layers = {}
    for name in stack.names:
        found = resolution[name]
        layers[name] = {
            "channels": " ".join(found.channels),
            "part": parts[found.part].name or found.part,
            "type": str(parts[found.part].channels[found.channels[0]].dtype),
        } | value_range(stack[name])
    report = {
        "file": stack.path,
        "size": [stack.width, stack.height],
        "data window": [corner.tolist() for corner in stack.place.data.box],
        "display window": [corner.tolist() for corner in stack.place.display.box],
        "parts": len(parts),
        "layers": layers,
        "diagnostics": {
            name.removeprefix(DIAGNOSTICS): {
                "mean": float(rate.mean(dtype=np.float64)),
                "max": float(rate.max()),
                "pixels above 0": int(np.count_nonzero(rate)),
            }
            for name, rate in rates.items()
        },
        "noise of the mean light, relative to it": {},
        "shared tails": _tails(stack),
        "other channels": [name for name in further if name not in rates],
        "missing": _missing(stack),
        "proposed": [
            f'--layer {name}="{layer}"' for name, layer in propose(stack.source.view.parts, resolution).items()
        ],
        "methods": [
            name
            for name, method in by_standing("use", "niche").items()
            if not method.missing() and all(layer in stack for layer in method.needs)
        ],
        "auto": choose(stack),
        "attributes": {name: _plain(value) for name, value in sorted(stack.attributes.items())},
    }
    if "shared" in stack and "primal_var" in stack:
        noise = noise_of_light(stack["primal"], stack["primal_var"], stack["shared"])
        report["noise of the mean light, relative to it"] = noise
    absent = ("diagnostics", "noise of the mean light, relative to it", "shared tails", "proposed")
    return {name: value for name, value in report.items() if value or name not in absent}


def _tails(stack: GradientStack) -> str:
    """A sentence about the cache in which paths end, from the header; "" if the header does not mention one."""
    sentences = [str(stack.attributes[TAILS])] if TAILS in stack.attributes else []
    if (cut := stack.number(CUT)) is not None:
        sentences.append(f"{100 * cut:.3g} % of the cache's light was cut from records that were too bright")
    return "; ".join(sentences)


def _missing(stack: GradientStack) -> list[str]:
    """The layers that the stack lacks and methods could use.

    A file of another renderer has no gradients, so only features count as missing there.
    """
    wanted = [name for name in LAYERS if name not in _OPTIONAL]
    if "dx" not in stack and "ngpt:sampler" not in stack.attributes:
        wanted = ["albedo", "normal", "depth"]
    return [name for name in wanted if name not in stack]


def show(report: dict, as_json: bool) -> None:
    """Prints a description as JSON, or as lines for people."""
    if as_json:
        print_json(report)
        return
    for name, value in report.items():
        if isinstance(value, dict):
            tell(f"{name}:")
            for key, item in value.items():
                item = _fields(item) if key == REQUEST else item
                parts = [f"{k} {_number(v)}" for k, v in item.items()] if isinstance(item, dict) else [_number(item)]
                text = "  ".join(parts)
                if len(text) > _LETTERS and name == "attributes" and key != REQUEST:
                    text = f"{text[:_LETTERS]}... ({len(text)} letters; --json prints all)"
                _fitted(f"  {key:16} {text}", indent=4)
        elif isinstance(value, list) and value and isinstance(value[0], str) and max(map(len, value)) > 30:
            tell(f"{name}:")
            for item in value:
                _fitted(f"  {item}", indent=4)
        else:
            text = ", ".join(map(str, value)) or "none" if isinstance(value, list | tuple) else _number(value)
            _fitted(f"{name}: {text}", indent=2)


def _fields(text: str) -> object:
    """The fields that are set in a render request, parsed from its text in a header.

    Returns the text unchanged if it is not a request.
    """
    try:
        fields = parse_json(text, REQUEST)
    except NgptError:
        return text
    return {name: value for name, value in fields.items() if value} if isinstance(fields, dict) else text


def _fitted(line: str, indent: int) -> None:
    """Prints a line. On a terminal, it is broken between words, and further lines are indented by ``indent`` spaces."""
    if sys.stdout.isatty():
        width, start = shutil.get_terminal_size().columns, len(line) - len(line.lstrip())
        wrapper = textwrap.TextWrapper(width, " " * start, " " * indent, break_long_words=False, break_on_hyphens=False)
        line = wrapper.fill(line.lstrip())
    for part in line.split("\n"):
        tell(part)


def _number(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_number(item)}" for key, item in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _plain(value):
    """Converts a header attribute to a value that JSON can hold."""
    return value if isinstance(value, bool | int | float | str) else " ".join(str(value).split())
