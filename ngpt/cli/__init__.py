"""The command ``ngpt``: one verb, one module, which is imported only when its verb is called.

Exit status: 0 when everything asked for was done, 1 when some files failed or images differ, 2 for an error that
stopped the command, 130 when interrupted.
"""

import argparse
import shlex
import sys
from importlib import import_module
from typing import NamedTuple, NoReturn

from ngpt.errors import NgptError
from ngpt.system.console import Console, run_command
from ngpt.version import __version__


class Verb(NamedTuple):
    """What a verb does, which extra of ngpt-recon brings what it needs, and what an interrupt means for its work."""

    summary: str
    extra: str = ""
    interrupted: str = "interrupted"


_CONTINUES = "interrupted; run the same command to continue"

VERBS = {
    "demo": Verb("render built-in scenes, reconstruct with every method, and write a report to open in a browser"),
    "render": Verb("render a scene to a gradient stack"),
    "merge": Verb("merge stacks of one scene, rendered with different seeds, into one of all their samples"),
    "denoise": Verb("reconstruct images from gradient stacks"),
    "info": Verb("say what a file holds, or what a scene requires"),
    "unpack": Verb("write the layers of a stack as raw files, for hosts in other languages"),
    "diff": Verb("compare two images"),
    "report": Verb("make a page to compare images of any renderer in, with errors where there is a reference"),
    "advise": Verb("say which method and how many samples to use, for a time or an error"),
    "dataset": Verb("make a training set, or continue one", "train", _CONTINUES),
    "train": Verb("train a network, or continue a run", "train", _CONTINUES),
    "evaluate": Verb(
        "compare methods on the same scenes with the same clock",
        "train",
        "interrupted; the same command goes on from here",
    ),
    "export": Verb("write a reconstruction as an ONNX file", "export"),
}


class _Parser(argparse.ArgumentParser):
    """Reports a wrong call in one line, as all other errors are."""

    def error(self, message: str) -> NoReturn:
        Console().error(f"{message}; see `{self.prog} --help`")
        sys.exit(2)


def main(arguments: list[str] | None = None) -> int:
    """Runs a command line and returns its exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    # The options of ngpt itself have no values: the first word that is none of them is the verb.
    verb = next((word for word in words if not word.startswith("-")), "")
    interrupted = VERBS[verb].interrupted if verb in VERBS else "interrupted"
    return run_command(lambda: _work(_parser(verb), words, "ngpt"), interrupted=interrupted)


def door(verb: str, program: str, arguments: list[str] | None = None, name: str = "ngpt") -> int:
    """Runs a script of the repository that does what a verb does: ``python train.py``, ``python -m data_gen``.

    ``name`` is what its errors begin with.
    """
    words = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(program)
    return run_command(lambda: _work(_filled(parser, verb), words, program), name, VERBS[verb].interrupted)


def _parser(called: str) -> argparse.ArgumentParser:
    """Of all verbs, with the arguments of the one that is called."""
    parser = _Parser(prog="ngpt", description="Gradient-domain reconstruction of Monte Carlo renderings.")
    parser.add_argument("--version", action="version", version=f"ngpt {__version__}")
    verbs = parser.add_subparsers(required=True, metavar="VERB", parser_class=_Parser)
    for verb, (summary, *_) in VERBS.items():
        subparser = verbs.add_parser(verb, help=summary)
        if verb == called:
            _filled(subparser, verb)
    return parser


def _filled(parser: argparse.ArgumentParser, verb: str) -> argparse.ArgumentParser:
    """The parser, with what its verb is and the arguments of it."""
    summary = VERBS[verb].summary
    parser.description = f"{summary[0].upper()}{summary[1:]}."
    parser.set_defaults(verb=verb)
    parser.add_argument("-q", "--quiet", action="store_true", help="say nothing but errors")
    import_module(f"ngpt.cli.{verb}").add_arguments(parser)
    return parser


def _work(parser: argparse.ArgumentParser, words: list[str], program: str) -> int:
    args = parser.parse_args(words)
    args.command = f"{program} {shlex.join(words)}"
    try:
        return import_module(f"ngpt.cli.{args.verb}").run(args, Console(args.quiet))
    except ModuleNotFoundError as error:
        if not (extra := VERBS[args.verb].extra):
            raise
        raise NgptError(f"{args.verb} needs the package '{error.name}'; `pip install 'ngpt-recon[{extra}]'`") from error
