"""``ngpt --completion SHELL``: scripts for the completion of verbs, options and values, made from the parsers."""

import argparse
import re
from collections.abc import Iterable

# An option takes a file or a folder if help gives its value one of these names.
_FILES = re.compile(r"FILE|OUT|REF|PATH|DIR|FOLDER|PAGE|CONFIG|\.\w+$")


def script(shell: str, top: argparse.ArgumentParser, verbs: dict[str, argparse.ArgumentParser]) -> str:
    """The script for "bash", "zsh" or "fish", from the parser of ngpt and the parsers of its verbs by name."""
    if shell == "fish":
        return _fish(top, verbs)
    # zsh can run the script for bash.
    return (_ZSH if shell == "zsh" else "") + _bash(top, verbs)


def options(parser: argparse.ArgumentParser) -> Iterable[argparse.Action]:
    """The options of a parser, without its positional arguments."""
    return (action for action in parser._actions if action.option_strings)


def takes_files(action: argparse.Action) -> bool:
    return bool(action.metavar and _FILES.search(str(action.metavar)))


_ZSH = """\
(( $+functions[compdef] )) || { autoload -U +X compinit && compinit }
autoload -U +X bashcompinit && bashcompinit
"""

_BASH = """\
_ngpt() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" verb="" words="" each
    for each in "${{COMP_WORDS[@]:1:$((COMP_CWORD - 1))}}"; do
        if [[ $each != -* ]]; then verb=$each; break; fi
    done
    case "$verb:$before" in
{values}
    esac
    if [[ -z $words && ( -z $verb || $word == -* ) ]]; then
        case "$verb" in
{names}
        esac
    fi
    if [[ -n $words ]]; then
        COMPREPLY=( $(compgen -W "$words" -- "$word") )
    else
        COMPREPLY=( $(compgen -f -- "$word") )
    fi
}}
complete -o filenames -F _ngpt ngpt
"""


def _bash(top: argparse.ArgumentParser, verbs: dict[str, argparse.ArgumentParser]) -> str:
    values, names = [], []
    for verb, parser in {"": top, **verbs}.items():
        known = [name for action in options(parser) for name in action.option_strings]
        names.append(f'            "{verb}") words="{" ".join([*known, *([] if verb else verbs)])}" ;;')
        for action in options(parser):
            if action.nargs == 0:
                continue
            flags = "|".join(f'"{verb}:{name}"' for name in action.option_strings)
            if action.choices:
                values.append(f'        {flags}) words="{" ".join(map(str, action.choices))}" ;;')
            elif takes_files(action):
                values.append(f'        {flags}) COMPREPLY=( $(compgen -f -- "$word") ); return ;;')
            else:
                values.append(f"        {flags}) return ;;")
    return _BASH.format(values="\n".join(values), names="\n".join(names))


def _fish(top: argparse.ArgumentParser, verbs: dict[str, argparse.ArgumentParser]) -> str:
    lines = ["complete -c ngpt -f -n __fish_use_subcommand"]
    for verb, parser in verbs.items():
        lines.append(f"complete -c ngpt -n __fish_use_subcommand -a {verb} -d {_quoted(parser.description)}")
    for verb, parser in {"": top, **verbs}.items():
        when = f"'__fish_seen_subcommand_from {verb}'" if verb else "__fish_use_subcommand"
        for action in options(parser):
            words = [f"complete -c ngpt -n {when}"]
            words += [f"-l {n[2:]}" if n.startswith("--") else f"-s {n[1:]}" for n in action.option_strings]
            if action.choices:
                words.append(f"-x -a {_quoted(' '.join(map(str, action.choices)))}")
            elif action.nargs != 0:
                words.append("-r -F" if takes_files(action) else "-x")
            lines.append(" ".join([*words, f"-d {_quoted(action.help)}"]))
    return "\n".join(lines) + "\n"


def _quoted(text: str | None) -> str:
    """The first phrase of a help text, quoted for fish."""
    first = re.split(r"[;:.(]", (text or "").replace("%%", "%"))[0].strip()
    return "'" + first.replace("\\", "\\\\").replace("'", "\\'") + "'"
