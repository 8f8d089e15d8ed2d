"""``ngpt --manual``: the manual page, ngpt(1), made of the parsers; and the same as a page of the documentation."""

import argparse

from ngpt.version import __version__

STATUS = (
    ("0", "everything that was asked for was done"),
    ("1", "some files failed, or images differ"),
    ("2", "an error stopped the command"),
    ("130", "it was interrupted"),
)


def page(top: argparse.ArgumentParser, verbs: dict[str, argparse.ArgumentParser]) -> str:
    """The page in roff, for man; ``verbs`` are the parsers below ``top``."""
    lines = [f'.TH NGPT 1 "" "ngpt {__version__}" "User Commands"', ".SH NAME"]
    lines += [r"ngpt \- " + _escaped(_as_clause(str(top.description))), ".SH SYNOPSIS"]
    lines += [r".B ngpt", "[OPTION]", ".br", r".B ngpt", r"\fIVERB\fR ...", ".SH OPTIONS", *_options(top), ".SH VERBS"]
    for name, parser in verbs.items():
        lines += [f".SS ngpt {name}", _escaped(parser.description), ".PP"]
        usage = parser.format_usage().removeprefix("usage: ")
        lines += [".nf", *map(_escaped, usage.rstrip().splitlines()), ".fi", *_options(parser)]
        lines += [".PP", _escaped(parser.epilog)] if parser.epilog else []
    lines += [".SH EXIT STATUS"]
    for status, meaning in STATUS:
        lines += [".TP", f".B {status}", meaning]
    return "\n".join(lines) + "\n"


def markdown(verbs: dict[str, argparse.ArgumentParser]) -> str:
    """What each verb's --help says, as a page in Markdown."""
    parts = ["# Commands", "What `ngpt VERB --help` prints."]
    for name, parser in verbs.items():
        parts.append(f"## {name}\n\n```text\n{parser.format_help().rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def _as_clause(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:].rstrip(".")


def _options(parser: argparse.ArgumentParser) -> list[str]:
    formatter = parser._get_formatter()
    lines = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            continue
        lines += [".TP", rf"\fB{_escaped(formatter._format_action_invocation(action))}\fR"]
        lines.append(_escaped(formatter._expand_help(action) if action.help else ""))
    return lines


def _escaped(text: str | None) -> str:
    """A text as roff takes it literally, in one line."""
    plain = " ".join((text or "").split()).replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{plain}" if plain.startswith((".", "'")) else plain
