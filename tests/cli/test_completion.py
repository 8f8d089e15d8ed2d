"""Shell completion: made of the parsers, taken by the shells."""

import shutil
import subprocess

import pytest

from ngpt.cli import all_verbs, main, parsers
from ngpt.cli.completion import options


@pytest.fixture(scope="module")
def verbs():
    return parsers()


def printed(capfd, *arguments):
    with pytest.raises(SystemExit) as left:
        main([*arguments])
    output, errors = capfd.readouterr()
    assert (left.value.code or 0, errors) == (0, "")
    return output


def shell(name):
    """The program, or a skip where it is not installed."""
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    return name


# What bash and zsh hand to a completion function, and what it gave.
ASK = '\nCOMP_WORDS=({words}); COMP_CWORD={last}; _ngpt; echo "${{COMPREPLY[@]}}"\n'


@pytest.mark.parametrize("name", ["bash", "zsh", "fish"])
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("den", "denoise"),
        ("--comp", "--completion"),
        ("--completion b", "bash"),
        ("denoise -m wc", "wcv"),
        ("denoise x.exr --skip", "--skip-existing"),
        ("render sc --ad", "--adaptive"),
        ("denoise -o fil", "file.exr"),
    ],
)
def test_words_are_completed(name, line, expected, capfd, tmp_path):
    script, words = printed(capfd, "--completion", name), ["ngpt", *line.split()]
    (tmp_path / "file.exr").touch()
    ask = ASK.format(words=" ".join(words), last=len(words) - 1)
    if name == "fish":
        ask = f"\ncomplete -C '{' '.join(words)}'\n"
    elif name == "zsh":
        # Without a line editor nobody completes: compinit is left out. With arrays from 0, as bashcompinit has it.
        script, ask = f"compdef() {{ :; }}\n{script}", f"\nemulate sh{ask}"
    command = [shell(name), {"fish": "--no-config", "zsh": "-f", "bash": "--norc"}[name]]
    done = subprocess.run(command, input=script + ask, capture_output=True, text=True, cwd=tmp_path)
    # zsh leaves it to its line editor to take those that begin so.
    offered = {word.split("\t")[0] for word in done.stdout.replace(" ", "\n").split("\n")}
    assert {one for one in offered if one and one.startswith(words[-1])} == {expected}, done.stderr


def test_completion_knows_every_option(verbs, capfd):
    scripts = {name: printed(capfd, "--completion", name) for name in ("bash", "zsh", "fish")}
    assert verbs.keys() == all_verbs().keys()
    for parser in verbs.values():
        for action in options(parser):
            long = action.option_strings[-1]
            assert long in scripts["bash"] and long in scripts["zsh"]
            assert f"-{'l' if long.startswith('--') else 's'} {long.lstrip('-')}" in scripts["fish"]
