"""Rendering from Python: what `ngpt render` does, without its command line."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from unbiased import load, same

import data_gen
import ngpt
from ngpt.errors import NgptError

pytest.importorskip("mitsuba")

from data_gen.inspect import inspect_scene
from data_gen.render import render_stack

SIZE = (16, 12)


def test_a_file_a_name_and_a_scene_give_the_bits_of_the_command(renderer, command):
    assert "sampler 'primal', method 'oidn': " in command("render diffuse --size 16x12 --spp 4 --seed 3 -o s.exr")
    told = []
    stack, plan = data_gen.render_scene("diffuse", 4, 3, size=SIZE, chosen=told.append)
    same(ngpt.read("s.exr"), stack)
    assert told == [plan]
    assert (plan.sampler, plan.method, plan.shared) == ("primal", "oidn", False) and "more samples pay" in plan.reason
    scene = data_gen.load_scene("diffuse", SIZE)
    again, plan = data_gen.render_scene(scene, 4, 3, "primal", chosen=told.append)
    same(stack, again)
    assert plan.sampler == "primal" and len(told) == 1
    for asked in ({"size": SIZE}, {"sensor": 1}):
        with pytest.raises(NgptError, match=r"of a loaded scene are fixed; give them to data_gen\.load_scene"):
            data_gen.render_scene(scene, **asked)


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
    with pytest.raises(NgptError, match="--for needs --adaptive"):
        data_gen.render_scene("diffuse", 4, method="wcv")


SENSORS = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective" id="wide"><film type="hdrfilm"><integer name="width" value="8"/>
<integer name="height" value="6"/></film></sensor>
<sensor type="perspective" id="close"><float name="fov" value="20"/>
<film type="hdrfilm"><integer name="width" value="6"/>
<integer name="height" value="4"/><string name="pixel_format" value="luminance"/></film></sensor>
<sensor type="batch"><sensor type="perspective"/><sensor type="perspective"/></sensor>
<emitter type="constant"/><shape type="sphere"><point name="center" x="0" y="0" z="3"/><emitter type="area"/></shape>
<shape type="shapegroup" id="group"><shape type="cube"/></shape><emitter type="point"/>
<shape type="instance"><ref id="group"/><transform name="to_world"><translate x="1" z="6"/></transform></shape>
</scene>"""


def test_one_of_several_sensors_by_number_or_id(renderer, command):
    Path("three.xml").write_text(SENSORS)
    file, told = "three.xml", []
    stack, _ = data_gen.render_scene(file, 2, said=told.append)
    assert told == ["there are 3 sensors (0 'wide', 1 'close', 2), and none is named: 0 is rendered"]
    assert stack["primal"].shape == (6, 8, 3) and stack["primal"].mean() > 0
    close = [data_gen.render_scene(file, 2, sensor=name, said=told.append).stack for name in (1, "1", "close")]
    assert close[0]["primal"].shape == (4, 6, 3) and len(told) == 1
    # What is asked of size goes to that sensor's film, and to frames the same.
    assert data_gen.render_scene(file, 2, sensor="close", size=(5, 3)).stack["primal"].shape == (3, 5, 3)
    ((_, frame),) = data_gen.render_frames(file, [0], 2, sensor=1)
    assert frame["primal"].shape == (4, 6, 3)
    assert "none is named" not in command("render three.xml --sensor close --spp 2 -o s.exr")
    for other in (*close, ngpt.read("s.exr")):
        same(close[0], other)
    assert len(data_gen.load_scene(file).sensors()) == 3
    found = inspect_scene(file)
    wide = "0 'wide': perspective, 8x6, the one that is rendered"
    assert found["sensors"] == [wide, "1 'close': perspective, 6x4", "2: batch, size not given"]
    assert found["size"] == (8, 6)


@pytest.mark.parametrize(
    ("scene", "sensor", "message"),
    [
        ("three.xml", "clos", r"no sensor 'clos'; did you mean 'close'\? choose one of: 0 'wide', 1 'close', 2$"),
        ("three.xml", 3, "there is no sensor '3'"),
        ("three.xml", -1, "there is no sensor '-1'"),
        ("three.xml", 2, "camera 'batch': several cameras"),
        ("diffuse", "wide", r"diffuse: there is no sensor 'wide'; choose one of: 0 'sensor'$"),
    ],
)
def test_sensors_that_cannot_be_rendered(renderer, tmp_path, monkeypatch, scene, sensor, message):
    monkeypatch.chdir(tmp_path)
    Path("three.xml").write_text(SENSORS)
    with pytest.raises(NgptError, match=message):
        data_gen.render_scene(scene, 2, sensor=sensor)


def test_frames_end_where_they_are_stopped(renderer):
    done = []
    for frame, stack in data_gen.render_frames("diffuse", [0, 2, 4], 2, size=SIZE, stop=lambda: len(done) == 2):
        done.append((frame, stack.attributes["ngpt:previousFrame"]))
    assert done == [(0, -2), (2, 0)]
    with pytest.raises(NgptError, match="use --dt 2"):
        data_gen.render_frames("diffuse", [0], dt=1)


def test_only_a_render_chooses_a_variant():
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
    box = renderer.cornell_box()
    for given, said in ((box, "load it: mi.load_dict"), ("diffuse", "data_gen.load_scene"), (3, "int is not a scene")):
        with pytest.raises(NgptError, match=said):
            render_stack(given, 2, unbiased=True)
    with pytest.raises(NgptError, match=r"load it: mi\.load_dict"):
        data_gen.render_scene(box)
    with pytest.raises(NgptError, match="a shot needs a scene file or a built-in scene, not a dict"):
        data_gen.render_frames(box, range(2))


def test_a_folder_in_place_of_a_scene_is_said_to_be_one(renderer, tmp_path):
    with pytest.raises(NgptError, match=r"is a folder; name a scene file$"):
        data_gen.load_scene(str(tmp_path))
    (tmp_path / "room.xml").write_text("")
    with pytest.raises(NgptError, match=r"is a folder; name a scene file, such as .*room\.xml$"):
        data_gen.load_scene(str(tmp_path))


def test_an_error_says_how_the_tensor_of_an_integrator_becomes_a_stack(renderer):
    box = renderer.cornell_box() | {"integrator": {"type": "gpt", "max_depth": 3}}
    box["sensor"]["film"] |= {"width": 16, "height": 12}
    scene = load(renderer, box)
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
