"""Beauty, albedo, normal and depth in files of their own, and layers and views as ``ngpt info`` lists them."""

import json

import numpy as np
from exr_files import write_raw
from full_stack import full_stack

import ngpt


def test_files_of_layers_are_denoised_as_one_stack(tmp_path, command):
    """They win over layers in the stack; the result holds all, so that it can be denoised again."""
    stack = full_stack(10, 12)
    for name in ("albedo", "normal"):
        write_raw(tmp_path / f"{name}.exr", ({c: stack[name][..., i] for i, c in enumerate("RGB")},))
    write_raw(tmp_path / "depth.exr", ({"Z": stack["depth"][..., 0]},))
    whole = ngpt.GradientStack({n: stack[n] for n in ("primal", "primal_var", "albedo", "normal", "depth")})
    beauty = {"primal": stack["primal"], "primal_var": stack["primal_var"], "albedo": stack["albedo"] / 2}
    ngpt.write(tmp_path / "beauty.exr", ngpt.GradientStack(beauty))
    command("denoise beauty.exr --albedo albedo.exr --normal normal.exr --depth depth.exr -o out.exr -m nfor -q")
    assert np.array_equal(ngpt.read_image("out.exr"), ngpt.denoise(whole, "nfor"))
    again = ngpt.read("out.exr")
    assert set(again.names) == set(whole.names)
    assert all(np.array_equal(again[name], whole[name]) for name in whole.names)


def test_info_proposes_the_option_for_a_layer_that_looks_like_a_missing_one(tmp_path, command):
    image = np.ones((6, 8), np.float32)
    write_raw(tmp_path / "odd.exr", ({f"{layer}{c}": image for layer in ("", "base color.") for c in "RGB"},))
    assert json.loads(command("info odd.exr --json").out)["proposed"] == ['--layer albedo="base color"']
    assert "proposed" not in command("info odd.exr --layer 'albedo=base color'").out


def test_info_lists_layers_and_views_even_where_one_is_ambiguous(tmp_path, command):
    image = np.ones((6, 8), np.float32)
    write_raw(tmp_path / "near.exr", ({f"{v}.Combined.{c}": image for v in ("Near", "Far") for c in "RGB"},))
    eyes = {f"{v}{c}": image for v in ("", "right.") for c in "RGB"}
    write_raw(tmp_path / "both.exr", (eyes, {"multiView": ["left", "right"]}))
    output, errors = command("info near.exr --json", 1)
    assert json.loads(output)["layers"] == {"Far.Combined": "R G B", "Near.Combined": "R G B"}
    assert "layer 'primal' could be any of" in errors
    report = json.loads(command("info both.exr --json").out)
    assert report["views"] == ["left", "right"] and report["layers"]["primal"]["channels"] == "R G B"
    right = json.loads(command("info both.exr --view right --json").out)
    assert right["layers"]["primal"]["channels"] == "right.R right.G right.B"
    assert json.loads(command("info both.exr --layer albedo=x --json", 1).out)["layers of right"] == {"root": "R G B"}
    assert command("report both.exr -o page.html").err.count("has the views left, right; left is read") == 1
    for line in ("picture both.exr --view right -o right.png", "denoise both.exr --view right -m primal -o a.png"):
        command(line)
