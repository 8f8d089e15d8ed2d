"""Rendering from Python: what `ngpt render` does, without its command line."""

import re
import subprocess
import sys

import numpy as np
import pytest

import data_gen
from ngpt.errors import NgptError

SIZE = (16, 12)


def same(a, b):
    return a.names == b.names and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a.names)


def test_a_file_a_name_and_a_scene_give_the_bits_of_the_command(renderer, tmp_path):
    import ngpt
    from ngpt.cli import main

    target = tmp_path / "s.exr"
    assert main(["render", "diffuse", "--size", "16x12", "--spp", "4", "--seed", "3", "-q", "-o", str(target)]) == 0
    told = []
    stack, plan = data_gen.render_scene("diffuse", 4, 3, size=SIZE, chosen=told.append)
    assert same(ngpt.read(target), stack) and told == [plan]
    assert (plan.sampler, plan.method, plan.shared) == ("gpt", "", False) and "the integrator is" in plan.reason
    scene = data_gen.load_scene("diffuse", SIZE)
    again, plan = data_gen.render_scene(scene, 4, 3, "gpt", chosen=told.append)
    assert same(stack, again) and plan.sampler == "gpt" and len(told) == 1
    with pytest.raises(NgptError, match="load it with them"):
        data_gen.render_scene(scene, size=SIZE)


def test_options_samples_that_differ_and_what_ends_a_render(renderer):
    stack, _ = data_gen.render_scene("diffuse", 2, sampler="gpt", size=SIZE, caustic=False)
    assert "caustic" not in stack
    stack, plan = data_gen.render_scene("diffuse", 48, sampler="gpt", size=SIZE, error=0.5, method="wcv")
    assert plan.shared and plan.method == "wcv" and stack.attributes["ngpt:error"] <= 0.5
    passes = []
    stack, _ = data_gen.render_scene(
        "diffuse", 1 << 24, sampler="primal", size=SIZE, progress=lambda *at: passes.append(at), stop=lambda: True
    )
    assert passes[-1][0] == stack.attributes["ngpt:spp"] < 1 << 24
    with pytest.raises(NgptError, match="--for says what"):
        data_gen.render_scene("diffuse", 4, method="wcv")


def test_frames_end_where_they_are_stopped(renderer):
    done = []
    for frame, stack in data_gen.render_frames("diffuse", [0, 2, 4], 2, size=SIZE, stop=lambda: len(done) == 2):
        done.append((frame, stack.attributes["ngpt:previousFrame"]))
    assert done == [(0, -2), (2, 0)]
    with pytest.raises(NgptError, match="use --dt 2"):
        data_gen.render_frames("diffuse", [0], dt=1)


def test_a_variant_is_chosen_by_a_render_alone():
    code = (
        "import sys, data_gen\n"
        "data_gen.render_scene; data_gen.stop_on_ctrl_c\n"
        "assert 'mitsuba' not in sys.modules or sys.modules['mitsuba'].variant() is None\n"
        "stack, plan = data_gen.render_scene('diffuse', 1, size=(8, 8))\n"
        "import mitsuba as mi; assert mi.variant() == 'llvm_ad_rgb'\n"
        "mi.set_variant('llvm_ad_spectral')\n"
        "stack, plan = data_gen.render_scene('diffuse', 1, size=(8, 8)); assert mi.variant() == 'llvm_ad_spectral'\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_what_is_no_scene_is_said_with_its_remedy(renderer):
    from data_gen.render import render_stack

    box = renderer.cornell_box()
    for given, said in ((box, "load it: mi.load_dict"), ("diffuse", "data_gen.load_scene"), (3, "an int is given")):
        with pytest.raises(NgptError, match=said):
            render_stack(given, 2)
    with pytest.raises(NgptError, match=r"load it: mi\.load_dict"):
        data_gen.render_scene(box)
    with pytest.raises(NgptError, match="a shot is of a scene file or a built-in scene, and a dict is given"):
        data_gen.render_frames(box, range(2))


def test_the_tensor_of_an_integrator_is_told_how_it_becomes_a_stack(renderer):
    import ngpt

    box = renderer.cornell_box() | {"integrator": {"type": "gpt", "max_depth": 3}}
    box["sensor"]["film"] |= {"width": 16, "height": 12}
    scene = renderer.load_dict(box)
    image = renderer.render(scene, spp=2)
    with pytest.raises(NgptError) as error:
        ngpt.denoise(image)
    (remedy,) = re.findall(r"pass (ngpt\S+ \S+),", str(error.value))
    assert ngpt.denoise(eval(remedy), "l1").shape == (12, 16, 3)


def test_a_missing_driver_is_said_with_what_to_use(renderer):
    if "cuda_ad_rgb" not in renderer.variants():
        pytest.skip("this Mitsuba knows no CUDA")
    code = "import data_gen; data_gen.use_variant('cuda_ad_rgb')"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if told.returncode == 0:
        pytest.skip("there is a driver")
    assert "cannot start: no NVIDIA driver was found; use llvm_ad_rgb" in told.stderr
