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


WHY = {
    "the scene has no lamps, so its image is black; add one": {"z": 4, "lamp": ""},
    "the image is black: the camera is inside an object 'ball', of which it sees the back": {"z": 0},
    "the image is black: the camera sees none of the shapes; check the to_world": {"z": 4, "to": 9},
    "the image is black: no light reaches what the camera sees": {"z": -4},
}


@pytest.fixture
def said(renderer, command, tmp_path):
    """What is said of the render of a scene."""

    def render(words="-o it.exr", **scene):
        (tmp_path / "it.xml").write_text(SCENE.format(**{"to": 0.5, "lamp": LAMP} | scene))
        return command(f"render it.xml --spp 2 --sampler primal {words}")

    return render


@pytest.mark.parametrize("why", WHY)
def test_a_black_image_is_explained_in_one_line(said, why):
    told = said(**WHY[why])
    assert told.count("black") == 1 and why in told, told
    assert not ngpt.read("it.exr")["primal"].any()


def test_a_shot_without_lamps_says_so_once_and_a_lit_scene_nothing(said):
    assert said("--frames 0:2 -o f{frame}.exr", z=4, lamp="").count("no lamps") == 1
    assert "black" not in said(z=4)
