"""The command ``ngpt``. Each verb has a module of its own, which is imported only when the verb is called.

The verbs that render are in ``data_gen.cli``. An entry point names them, so that nothing here imports the renderer.

All verbs share these exit statuses: 0 when everything requested was done; 1 when the work failed for at least one file,
or images differ; 2 for a call that makes no sense (``WrongUse``); 130 after Ctrl-C and 143 after SIGTERM.
"""

import argparse
import os
import shlex
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ngpt.errors import NgptError, WrongUse, did_you_mean
from ngpt.system.console import Console, logged, run_command
from ngpt.system.install import install_command, study
from ngpt.system.parts import brought, no_renderer
from ngpt.version import __version__


class Verb(NamedTuple):
    """A verb of the command line.

    ``summary``      one line for help
    ``room``         the package that holds the verb's module; the module has the name of the verb
    ``extra``        the extra of ngpt-recon that installs the verb's dependencies; "" if it needs none
    ``interrupted``  the message after an interrupt
    ``heading``      the heading in help, one of ``HEADINGS``
    """

    summary: str
    room: str = "ngpt.cli"
    extra: str = ""
    interrupted: str = "interrupted"
    heading: str = "images"


HEADINGS = {"images": "images of any renderer", "rendering": "rendering", "networks": "networks"}

CONTINUES = "interrupted; run the same command to continue"
_GOES_ON = "interrupted; --skip-existing goes on with what is not done yet"

VERBS = {
    "denoise": Verb("reconstruct images from gradient stacks or noisy renders", interrupted=_GOES_ON),
    "info": Verb("describe a file, a scene, a method or a sampler"),
    "diff": Verb("compare two images"),
    "report": Verb("write a page that compares images of any renderer, with errors if there is a reference"),
    "picture": Verb("convert an image to PNG, JPEG or WebP, or a shot to a film, by a view transform"),
    "merge": Verb("merge stacks of one image, with different seeds or tiles, into one"),
    "unpack": Verb("write the layers of a stack as raw files, for programs in other languages"),
    "train": Verb("train a network, or continue a run", extra="train", interrupted=CONTINUES, heading="networks"),
    "evaluate": Verb(
        "compare methods on the same scenes with the same clock",
        extra="train",
        interrupted="interrupted; the same command goes on from here",
        heading="networks",
    ),
    "export": Verb(
        "convert a trained network to ONNX, to OIDN's format or to 16 bits", extra="export", heading="networks"
    ),
}


def all_verbs() -> dict[str, Verb]:
    """The verbs of ngpt and of other packages, ordered by their headings.

    Another package brings verbs by an entry point of the group "ngpt.verbs" that names a dictionary like ``VERBS``.
    """
    found: dict[str, Verb] = {}
    for verbs in brought("ngpt.verbs"):
        found |= verbs
    order = list(HEADINGS)
    return dict(sorted((found | VERBS).items(), key=lambda item: order.index(item[1].heading)))


class _Parser(argparse.ArgumentParser):
    """A parser that reports a wrong call in one line, as all other errors are reported."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            registry = getattr(action.choices, "registry", None)
            if registry is not None and (line := study(registry.what, str(value))):
                raise WrongUse(line)
            known = list(map(str, action.choices))
            text = f"invalid choice: '{value}'; {did_you_mean(str(value), known)}choose one of: {', '.join(known)}"
            raise argparse.ArgumentError(action, text)

    def error(self, message: str) -> NoReturn:
        Console().error(f"{message}{'' if message.endswith('?') else ';'} see `{self.prog} --help`")
        sys.exit(2)


class _Top(_Parser):
    """The parser of ``ngpt`` itself. Its help lists the ``verbs`` under headings."""

    verbs: dict[str, Verb]

    def format_help(self) -> str:
        formatter, verbs = self._get_formatter(), self.verbs
        group: Any = self._subparsers
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        for heading, title in HEADINGS.items():
            formatter.start_section(title)
            for action in group._group_actions[0]._get_subactions():
                if verbs[action.dest].heading == heading:
                    formatter.add_argument(action)
            formatter.end_section()
        formatter.start_section("options")
        formatter.add_arguments(self._optionals._group_actions)
        formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


class _Completion(argparse.Action):
    """Prints the completion script of a shell and exits."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option: str | None = None) -> None:
        from ngpt.cli.completion import script

        print(script(values, parser, parsers()), end="")
        parser.exit()


def parsers() -> dict[str, argparse.ArgumentParser]:
    """The complete parser of each verb, by its name."""
    return {name: _filled(_Parser(prog=f"ngpt {name}"), name, verb) for name, verb in all_verbs().items()}


def main(arguments: list[str] | None = None) -> int:
    """Runs a command line and returns its exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    # The verb is the first word that is not an option. Only --completion takes a value, and it needs no verb.
    called = "" if words[:1] == ["--completion"] else next((word for word in words if not word.startswith("-")), "")
    # The search for the verbs of other packages takes time, so they are searched only if needed.
    verbs = VERBS if called in VERBS else all_verbs()
    interrupted = verbs[called].interrupted if called in verbs else "interrupted"
    return run_command(lambda: _work(_parser(called, verbs), verbs, words, "ngpt"), interrupted=interrupted)


def door(
    verb: str, program: str, arguments: list[str] | None = None, name: str = "ngpt", verbs: Mapping[str, Verb] = VERBS
) -> int:
    """Runs a verb for a script of the repository, such as ``train.py``, and returns the exit status.

    ``program``    the command as help shows it: "python train.py"
    ``arguments``  the words after the command; None for the words that this process was started with
    ``name``       the beginning of the verb's error messages
    ``verbs``      a dictionary with the verb, for packages that are not installed
    """
    words = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(program)
    return run_command(
        lambda: _work(_filled(parser, verb, verbs[verb]), verbs, words, program), name, verbs[verb].interrupted
    )


def _parser(called: str, verbs: dict[str, Verb]) -> argparse.ArgumentParser:
    """The parser of ``ngpt``, with the names of all ``verbs`` and the arguments of the ``called`` one."""
    if called and called not in verbs:
        meant = did_you_mean(called, verbs)
        if not meant and verbs.keys() == VERBS.keys():
            raise WrongUse(f"there is no verb '{called}' here; {no_renderer()}")
        raise WrongUse(f"there is no verb '{called}'; {meant}verbs: {', '.join(verbs)}; see `ngpt --help`")
    parser = _Top(prog="ngpt", description="Gradient-domain reconstruction of Monte Carlo renderings.")
    parser.verbs = verbs
    parser.epilog = "Exit status: 0 done, 1 work failed or images differ, 2 wrong use, 130 Ctrl-C, 143 SIGTERM."
    parser.add_argument("--version", action="version", version=f"ngpt {__version__}")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=("bash", "zsh", "fish"),
        metavar="SHELL",
        help="print the completion script of a shell: bash, zsh or fish",
    )
    subparsers = parser.add_subparsers(required=True, metavar="VERB", parser_class=_Parser)
    for name, verb in verbs.items():
        subparser = subparsers.add_parser(name, help=verb.summary)
        if name == called:
            _filled(subparser, name, verb)
    return parser


def _filled(parser: argparse.ArgumentParser, name: str, verb: Verb) -> argparse.ArgumentParser:
    """Adds the description and the arguments of a verb to the ``parser``, and returns it."""
    parser.description = f"{verb.summary[0].upper()}{verb.summary[1:]}."
    parser.set_defaults(verb=name, parser=parser)
    loud = parser.add_mutually_exclusive_group()
    loud.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    loud.add_argument("-v", "--verbose", action="store_true", help="print what is read, chosen and run")
    import_module(f"{verb.room}.{name}").add_arguments(parser)
    return parser


def _work(parser: argparse.ArgumentParser, verbs: Mapping[str, Verb], words: list[str], program: str) -> int:
    args, unknown = parser.parse_known_args(words)
    if unknown:
        meant = did_you_mean(unknown[0].partition("=")[0], args.parser._option_string_actions)
        args.parser.error(f"unrecognized argument '{unknown[0]}'{f'; {meant}' if meant else ''}".rstrip())
    # Shells do not expand the tilde in --output=~/it.exr.
    for name in ("output", "out"):
        if isinstance(path := getattr(args, name, None), str | Path):
            setattr(args, name, type(path)(os.path.expanduser(path)))
    args.command, verb = f"{program} {shlex.join(words)}", verbs[args.verb]
    try:
        with logged(args.verbose, args.quiet):
            return import_module(f"{verb.room}.{args.verb}").run(args, Console(args.quiet))
    except ModuleNotFoundError as error:
        if not verb.extra:
            raise
        raise NgptError(f"{args.verb} needs the package '{error.name}'; `{install_command(verb.extra)}`") from error
