"""Verbs as a whole: what they import, the scripts that are doors to some of them, and what they say when stopped."""

import importlib
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from exr_files import write_raw

from ngpt.cli import all_verbs, main
from ngpt.system import parts
from ngpt.system.install import install_command

VERBS = all_verbs()

DOORS = {"dataset": "data_gen/__main__.py", "train": "train.py", "evaluate": "eval.py", "export": "export/__main__.py"}


def run_python(code, *arguments, cwd=None):
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=cwd)


def stopped(function, arguments, capfd):
    """Standard output and error of a command that ends before it works."""
    with pytest.raises(SystemExit) as exit:
        function(arguments)
    return exit.value.code, *capfd.readouterr()


def test_no_help_imports_what_is_heavy():
    code = (
        "import contextlib, io, sys\n"
        "from ngpt.cli import main\n"
        "heavy = {'torch', 'mitsuba', 'drjit', 'onnx', 'skimage'}\n"
        "for verb in ['', *sys.argv[1:]]:\n"
        "    arguments, unwanted = ([verb, '--help'], heavy) if verb else (['--help'], heavy | {'numpy'})\n"
        "    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main(arguments)\n"
        "    assert not unwanted & set(sys.modules), (arguments, unwanted & set(sys.modules))\n"
    )
    run = run_python(code, *VERBS)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("verb", VERBS)
def test_a_wrong_option_is_said_in_one_line(verb, capfd):
    status, output, errors = stopped(main, [verb, "--nonsense"], capfd)
    assert status == 2 and output == "" and errors.count("\n") == 1
    assert re.match(rf"ngpt: error: .*[;?] see `ngpt( {verb})? --help`\n", errors)


@pytest.mark.parametrize("verb", DOORS)
def test_a_door_takes_what_its_verb_takes(verb, capfd, monkeypatch):
    """Also where nothing is installed: in a checkout that is only on the path there are no entry points."""
    theirs = stopped(main, [verb, "--help"], capfd)
    monkeypatch.setattr(parts, "points", lambda group: iter(()))
    door = runpy.run_path(DOORS[verb])["main"]
    helps = [stopped(door, ["--help"], capfd), theirs]
    assert [status for status, *_ in helps] == [0, 0]
    ours, theirs = (output[output.index("\n\n") :] for _, output, _ in helps)
    assert ours == theirs and "--help" in ours
    status, _, errors = stopped(door, ["--nonsense"], capfd)
    assert status == 2 and errors.startswith("usage: python ")
    assert re.search("error: (unrecognized argument|the following arguments)", errors)


@pytest.mark.parametrize(
    ("verb", "arguments", "message"),
    [
        ("dataset", ["--config", "x", "--out", "y"], "interrupted; run the same command to continue"),
        ("train", ["--config", "x"], "interrupted; run the same command to continue"),
        ("evaluate", ["--config", "x", "--out", "y"], "interrupted; the same command goes on from here"),
        ("export", ["-o", "x.onnx"], "interrupted"),
    ],
)
def test_ctrl_c_says_what_becomes_of_the_work(verb, arguments, message, capfd, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module(f"{VERBS[verb].room}.{verb}"), "run", interrupt)
    assert main([verb, *arguments]) == 130
    assert capfd.readouterr().err == f"ngpt: error: {message}\n"


@pytest.mark.parametrize(
    ("lacking", "line", "status", "told"),
    [
        ("torch", "train --config tiny --dry-run", 1, "train needs the package 'torch'"),
        ("onnx", "export -o x.onnx", 1, "export needs the package 'onnx'"),
        ("data_gen", "render diffuse", 2, "rendering needs the package data_gen, which is not installed"),
        ("data_gen", "evaluate --config eval-tiny --out out", 1, "the package data_gen, which is not installed"),
    ],
)
def test_a_package_that_is_not_installed_is_named_with_its_extra(lacking, line, status, told, tmp_path):
    code = f"import sys; sys.modules['{lacking}'] = None; from ngpt.cli import main; sys.exit(main(sys.argv[1:]))"
    run = run_python(code, *line.split(), cwd=tmp_path)
    extra = "render" if lacking == "data_gen" else line.split()[0]
    assert run.returncode == status and run.stderr.count("\n") == 1
    assert run.stderr.endswith(f"{told}; `{install_command(extra)}`\n")


@pytest.mark.parametrize("name", ["CShading_Albedo", "Info: Diffuse filter", "FinalImageBaseColor"])
def test_layers_that_look_like_features_are_not_passed_over_in_silence(tmp_path, name, command):
    """As Corona, Octane and Unreal call them, which names of layers nobody fixes."""
    pixels = np.full((6, 8), 0.5, np.float32)
    write_raw(tmp_path / "a.exr", (dict.fromkeys(("R", "G", "B", *(f"{name}.{c}" for c in "RGB")), pixels),))
    told = command("denoise a.exr -m nfor -o b.exr").err
    assert f"a.exr: '{name}' looks like albedo and was not used; --layer albedo=\"{name}\" takes it" in told
    told = command(f"denoise a.exr -m nfor -o c.exr --layer 'albedo={name}'").err
    assert "looks like" not in told


def test_a_tilde_after_an_equals_sign_is_the_home_folder(tmp_path, monkeypatch, command):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    write_raw(tmp_path / "a.exr", ({c: np.full((6, 8), 0.5, np.float32) for c in "RGB"},))
    command("picture a.exr --output=~/a.png")
    command("denoise a.exr -m primal --output=~/b.exr")
    assert sorted(path.name for path in (tmp_path / "home").iterdir()) == ["a.png", "b.exr"]
    assert not (tmp_path / "~").exists()
