"""The command ``ngpt``: one verb, one module.

Exit status: 0 when everything asked for was done, 1 when some files failed or images differ, 2 for an error that
stopped the command, 130 when interrupted.
"""

import argparse
import sys
from importlib import import_module
from typing import NoReturn

from ngpt.system.console import Console, run_command
from ngpt.version import __version__

VERBS = {
    "demo": "render built-in scenes, reconstruct with every method, and write a report to open in a browser",
    "render": "render a scene to a gradient stack",
    "merge": "merge stacks of one scene, rendered with different seeds, into one of all their samples",
    "denoise": "reconstruct images from gradient stacks",
    "info": "say what a file holds, or what a scene requires",
    "diff": "compare two images",
    "advise": "say which method and how many samples to use, for a time or an error",
}


class _Parser(argparse.ArgumentParser):
    """Reports a wrong call in one line, as all other errors are."""

    def error(self, message: str) -> NoReturn:
        Console().error(f"{message}; see `{self.prog} --help`")
        sys.exit(2)


def main(arguments: list[str] | None = None) -> int:
    """Runs a command line and returns its exit status."""
    return run_command(lambda: _run(arguments))


def _run(arguments: list[str] | None) -> int:
    parser = _Parser(prog="ngpt", description="Gradient-domain reconstruction of Monte Carlo renderings.")
    parser.add_argument("--version", action="version", version=f"ngpt {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB", parser_class=_Parser)
    for verb, summary in VERBS.items():
        subparser = verbs.add_parser(verb, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
        subparser.add_argument("-q", "--quiet", action="store_true", help="say nothing but errors")
        import_module(f"ngpt.cli.{verb}").add_arguments(subparser)
    args = parser.parse_args(arguments)
    return import_module(f"ngpt.cli.{args.verb}").run(args, Console(args.quiet))
