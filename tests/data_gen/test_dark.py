"""A black image comes with a line that says why."""

import pytest

import ngpt

pytest.importorskip("mitsuba")

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><transform name="to_world">
<lookat origin="0,0,{z}" target="0,0,{to}" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film></sensor>
<shape type="sphere" id="ball"><bsdf type="diffuse"/></shape>{lamp}</scene>"""
LAMP = '<emitter type="point"><point name="position" x="0" y="0" z="4"/></emitter>'


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ({"z": 4, "lamp": ""}, "the scene has no lamps, so its image is black; add one"),
        ({"z": 0}, "the image is black: the camera is inside an object 'ball', of which it sees the back"),
        ({"z": 4, "to": 9}, "the image is black: the camera sees none of the shapes; check the to_world"),
        ({"z": -4}, "the image is black: no light reaches what the camera sees"),
    ],
)
def test_a_black_image_is_explained_in_one_line(renderer, command, tmp_path, scene, said):
    (tmp_path / "it.xml").write_text(SCENE.format(**{"to": 0.5, "lamp": LAMP} | scene))
    told = command("render it.xml --spp 2 --sampler primal -o it.exr")
    assert told.count("black") == 1 and said in told, told
    assert not ngpt.read("it.exr")["primal"].any()


def test_a_shot_without_lamps_says_so_once(renderer, command, tmp_path):
    (tmp_path / "it.xml").write_text(SCENE.format(z=4, to=0, lamp=""))
    assert command("render it.xml --spp 1 --sampler primal --frames 0:2 -o f{frame}.exr").count("no lamps") == 1


def test_a_lit_scene_says_nothing(renderer, command, tmp_path):
    (tmp_path / "it.xml").write_text(SCENE.format(z=4, to=0, lamp=LAMP))
    assert "black" not in command("render it.xml --spp 1 --sampler primal -o it.exr")
