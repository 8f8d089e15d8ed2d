"""Arguments that several verbs share, and the conversion of their values."""

import argparse
import json
import logging
import math
import re
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path

from ngpt.errors import WrongUse
from ngpt.io.frames import input_files, is_shot
from ngpt.layers import LAYERS
from ngpt.system import configs
from ngpt.system.console import Console
from ngpt.system.files import check_output, make_folder
from ngpt.system.parts import Registry
from ngpt.system.text import by_names
from ngpt.system.writing import write_text

_LOG = logging.getLogger(__name__)

# Layers that many renderers write into separate files.
FILES = ("albedo", "normal", "depth")


def add_force(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--force", action="store_true", help="replace existing files")


def add_options(parser: argparse._ActionsContainer, owner: str, name: str) -> None:
    """Adds ``-O NAME=VALUE``, an option of the ``owner`` ("method"). Help refers to ``ngpt info`` and ``name``."""
    parser.add_argument(
        "-O",
        "--option",
        action="append",
        default=[],
        type=assignment,
        metavar="NAME=VALUE",
        help=f"an option of the {owner}; may be repeated. See `ngpt info {name}`",
    )


def output_file(path: str | Path, args: argparse.Namespace) -> Path:
    """The path of a file to write, after making its folder.

    ``args`` has ``force``, and ``skip_existing`` if the verb has that option. Raises NgptError if the folder cannot be
    made, or if the file exists and neither option is given.
    """
    skip = getattr(args, "skip_existing", None)
    make_folder(Path(path).parent)
    is_exr = Path(path).suffix.lower() == ".exr"
    return check_output(path, args.force or bool(skip), may_skip=skip is not None and is_exr)


def add_config(parser: argparse.ArgumentParser, kind: str, what: str) -> None:
    """Adds ``--config`` and ``--init`` for one of the kinds of ``ngpt.system.configs``."""
    known = ", ".join(configs.names(kind))
    parser.add_argument("--config", metavar="CONFIG", help=f"{what}: a TOML file, or one of: {known}")
    parser.add_argument(
        "--init",
        metavar="FILE",
        help=f"only write the configuration (default: {configs.STARTS[kind]}) to this file, with every setting and its "
        "meaning",
    )


def config_of(args: argparse.Namespace, kind: str) -> Path:
    """The configuration that ``--config`` names, or the default start for ``--init``.

    Raises WrongUse if neither option is given, and NgptError if there is no such configuration.
    """
    if args.config is None and args.init is None:
        raise WrongUse(f"--config is missing: a TOML file, or one of: {', '.join(configs.names(kind))}")
    return configs.find_config(args.config or configs.STARTS[kind], kind)


def write_template(args: argparse.Namespace, text: str, verb: str, console: Console) -> int:
    """Writes a configuration to the file of ``--init`` and returns the exit status."""
    make_folder(Path(args.init).parent)
    target = check_output(args.init)
    write_text(target, text, overwrite=False)
    console.say(f"{target}: every setting; then: ngpt {verb} --config {target} --out DIR")
    return 0


class Names(Container[str]):
    """The names in a registry and "auto", as choices of an option.

    Iteration leaves out entries of other packages that are not imported yet.
    """

    def __init__(self, registry: Registry):
        self.registry = registry

    def __contains__(self, name: object) -> bool:
        return name == "auto" or name in self.registry

    def __iter__(self) -> Iterator[str]:
        return iter(("auto", *self.registry))


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print the result as JSON on standard output")


def add_untrusted(parser: argparse.ArgumentParser) -> None:
    what = "decode files in a separate process, so that a damaged or hostile file cannot crash this one"
    parser.add_argument("--untrusted", action="store_true", help=what)


def add_files(parser: argparse.ArgumentParser) -> None:
    for layer in FILES:
        parser.add_argument(f"--{layer}", metavar="FILE", help=f"read {layer} from this file (for one stack)")


def given_files(args: argparse.Namespace) -> dict[str, str]:
    """The files given by the options of ``add_files``, by layer."""
    return {layer: file for layer in FILES if (file := getattr(args, layer))}


def add_layers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--layer",
        action="append",
        default=[],
        type=assignment,
        metavar="NAME=LAYER",
        help="read NAME from this layer of the file, or from channels with signs and factors "
        f'("-velocity.R,velocity.G"); may be repeated. NAME: {", ".join(LAYERS)}',
    )


def add_view(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument("--view", metavar="NAME", help=f"view of a stereo file, such as left or right ({default})")


def assignment(text: str) -> tuple[str, str]:
    """``name=value`` as a pair."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form NAME=VALUE")
    return name, value


def size(text: str) -> tuple[int, int]:
    """``640x360`` as (width, height) in pixels."""
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a size; write WIDTHxHEIGHT in pixels, e.g. 640x360")
    return int(width), int(height)


def natural(text: str, least: int = 0) -> int:
    """A whole number of ``least`` or more."""
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of {least} or more")
    return int(text)


def positive(text: str) -> int:
    return natural(text, 1)


def duration(text: str) -> float:
    """A positive number of seconds."""
    return number(text, lambda seconds: 0 < seconds < math.inf, "is not a positive number of seconds")


def relative(text: str) -> float:
    """A number. The error for "5%" suggests to write 0.05."""
    try:
        return float(text)
    except ValueError:
        percent = re.fullmatch(r"(\d+(?:\.\d*)?) ?%", text)
        remedy = f"; write {float(percent[1]) / 100:g}" if percent else "; write 0.05 for 5 %"
        raise argparse.ArgumentTypeError(f"'{text}' is not a number{remedy}") from None


def number(text: str, fits: Callable[[float], bool], refusal: str) -> float:
    """The number in a text. If the text is no number that ``fits``, the error quotes it and ends in ``refusal``."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not fits(found):
        raise argparse.ArgumentTypeError(f"'{text}' {refusal}")
    return found


def stack_files(names: list[str]) -> list[Path]:
    """The files given by their names, by folders (every .exr in them) or by patterns, in order and without repeats.

    Results of earlier runs in folders and patterns are left out (``ngpt.io.frames``). Raises NgptError for a folder or
    pattern without a file. A file given by its name need not exist, since reading it later reports the error.
    """
    files = [path for name in names for path in (input_files(name) if is_shot(name) else [Path(name)])]
    return list(dict.fromkeys(files))


def tell_lacks(lacks: Mapping[str, str], console: Console) -> None:
    """Prints which metrics are left out. ``lacks`` maps them to reasons, which only --verbose shows."""
    for reason in lacks.values():
        _LOG.info(reason)
    if lacks:
        console.say(f"without {' and '.join(lacks)}: --verbose says why")


def print_json(value: object) -> None:
    """Prints a value as strict JSON: infinite numbers and NaN, which JSON does not have, become null."""
    print(json.dumps(_strict(value), indent=2))


def _strict(value):
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, str):
        return by_names(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def part(text: str) -> tuple[int, int]:
    """``i/n`` as (i, n): part i of n, counted from 0."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or int(match[1]) >= int(match[2]):
        raise argparse.ArgumentTypeError(f"'{text}' is not i/n with 0 <= i < n, such as 0/4")
    return int(match[1]), int(match[2])
