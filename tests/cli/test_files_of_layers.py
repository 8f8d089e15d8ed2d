"""Beauty, albedo, normal and depth in files of their own."""

import json

import numpy as np
import pytest
from exr_files import write_raw
from full_stack import full_stack

import ngpt
from ngpt.cli import main

SEEN, FEATURES = ("primal", "primal_var"), ("albedo", "normal", "depth")


@pytest.fixture
def apart(tmp_path):
    """The path of a file for each of primal, albedo, normal and depth; and the stack that they are of."""
    stack = full_stack(10, 12)
    paths = {}
    for name in ("primal", "albedo", "normal"):
        paths[name] = write_raw(tmp_path / f"{name}.exr", ({c: stack[name][..., i] for i, c in enumerate("RGB")},))
    paths["depth"] = write_raw(tmp_path / "depth.exr", ({"Z": stack["depth"][..., 0]},))
    return {name: str(path) for name, path in paths.items()}, stack


def options(paths):
    return [argument for name in FEATURES for argument in (f"--{name}", paths[name])]


def test_layers_from_files_of_their_own(apart):
    paths, stack = apart
    files = {name: paths[name] for name in FEATURES}
    together = ngpt.read(paths["primal"], files=files)
    assert together.names == ("primal", "albedo", "normal", "depth")
    for name in together.names:
        assert np.array_equal(together[name], stack[name])


def test_they_are_denoised_as_one_stack(apart, tmp_path):
    paths, stack = apart
    beauty, whole = (ngpt.GradientStack({name: stack[name] for name in names}) for names in (SEEN, (*SEEN, *FEATURES)))
    sources = [str(ngpt.write(tmp_path / name, layers)) for name, layers in (("b.exr", beauty), ("w.exr", whole))]
    results = [str(tmp_path / name) for name in ("out.exr", "same.exr")]
    assert main(["denoise", sources[0], *options(paths), "-o", results[0], "-m", "nfor", "-q"]) == 0
    assert main(["denoise", sources[1], "-o", results[1], "-m", "nfor", "-q"]) == 0
    assert np.array_equal(*map(ngpt.read_image, results))
    # The result holds them, so that it can be reconstructed again.
    assert ngpt.read(results[0]).names == ngpt.read(results[1]).names


def test_a_file_of_a_layer_wins_over_the_layer_in_the_stack(apart, tmp_path):
    paths, stack = apart
    whole = ngpt.write(tmp_path / "whole.exr", stack.replace(albedo=stack["albedo"] / 2))
    assert np.array_equal(ngpt.read(whole, files={"albedo": paths["albedo"]})["albedo"], stack["albedo"])


def test_info_proposes_the_option_for_a_layer_that_looks_like_a_missing_one(apart, tmp_path, capsys):
    _, stack = apart
    channels = {c: stack["primal"][..., i] for i, c in enumerate("RGB")}
    channels |= {f"base color.{c}": stack["albedo"][..., i] for i, c in enumerate("RGB")}
    path = str(write_raw(tmp_path / "odd.exr", (channels,)))
    assert main(["info", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["proposed"] == ['--layer albedo="base color"']
    assert main(["info", path, "--layer", "albedo=base color"]) == 0
    assert "proposed" not in capsys.readouterr().out


def test_info_lists_layers_and_views_even_where_one_is_ambiguous(tmp_path, capsys):
    image = np.ones((6, 8), np.float32)
    near, both = tmp_path / "near.exr", tmp_path / "both.exr"
    write_raw(near, ({f"{v}.Combined.{c}": image for v in ("Near", "Far") for c in "RGB"},))
    write_raw(both, ({f"{v}{c}": image for v in ("", "right.") for c in "RGB"}, {"multiView": ["left", "right"]}))
    assert main(["info", str(near), "--json"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["layers"] == {"Far.Combined": "R G B", "Near.Combined": "R G B"}
    assert "layer 'primal' could be any of" in told.err
    assert main(["info", str(both), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["views"] == ["left", "right"] and report["layers"]["primal"]["channels"] == "R G B"
    assert main(["info", str(both), "--view", "right", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["layers"]["primal"]["channels"] == "right.R right.G right.B"
    assert main(["info", str(both), "--layer", "albedo=x", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["layers of right"] == {"root": "R G B"}
    assert main(["picture", str(both), "--view", "right", "-o", str(tmp_path / "right.png")]) == 0
    assert main(["picture", str(both), "--view", "top", "-o", str(tmp_path / "top.png")]) == 1
    assert "has no view 'top'; it has left, right" in capsys.readouterr().err
