"""Light that a sampler cannot find is named in one line, with a sampler that finds it."""

import pytest

pytest.importorskip("mitsuba")

from data_gen.inspect import inspect_scene

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film></sensor>
<shape type="sphere"><float name="radius" value="0.5"/>{ball}</shape>
<shape type="rectangle"><transform name="to_world"><scale value="3"/><translate z="-1"/></transform></shape>
{lamp}</scene>"""
POINT = '<emitter type="point"><point name="position" x="0" y="1" z="4"/></emitter>'
LAMP = """<shape type="sphere"><point name="center" x="0" y="1" z="4"/><float name="radius" value="{}"/>
<emitter type="area"><rgb name="radiance" value="9"/></emitter></shape>"""
GLASS, MASK = '<bsdf type="dielectric"/>', '<bsdf type="mask"><bsdf type="diffuse"/></bsdf>'
IN_GLASS, IN_HOLES = "'{}' hardly finds the caustics of ", "'{}' loses light of lamps without size that"


@pytest.mark.parametrize(
    ("ball", "lamp", "sampler", "said"),
    [
        (GLASS, POINT, "gpt", IN_GLASS),
        (GLASS, LAMP.format(0.003), "primal", IN_GLASS),
        (GLASS, LAMP.format(0.3), "primal", ""),
        (GLASS, POINT, "vcm", ""),
        (MASK, POINT, "gpt", ""),
        (MASK, POINT, "bdpt", ""),
        (MASK, POINT, "gpt-basic", IN_HOLES),
        (MASK, LAMP.format(0.3), "gpt-basic", ""),
        ('<bsdf type="plastic"/>', POINT, "primal", ""),
    ],
)
def test_it_is_said_before_the_render(renderer, command, tmp_path, ball, lamp, sampler, said):
    (tmp_path / "it.xml").write_text(SCENE.format(ball=ball, lamp=lamp))
    told = command(f"render it.xml --spp 2 --sampler {sampler} -o it.exr")
    assert (said.format(sampler) in told) if said else "loses" not in told and "hardly finds" not in told, told
    assert said != IN_GLASS or "of the light on what the camera sees directly; --sampler vcm finds them" in told


@pytest.mark.parametrize(("rows", "bent"), [(6, True), (100, False)])
def test_lamps_of_few_faces_with_smooth_normals_are_named(renderer, rows, bent):
    """Mitsuba's issue 1952: densities of such lamps are those of another normal than samples."""
    from lamps_scenes import bowl
    from unbiased import load

    from data_gen.scenes.lost import bent_lamp

    lamp = bowl([0, 0, 0], 0.25, rows) | {"emitter": {"type": "area", "radiance": 4.0}}
    scene = load(renderer, {"type": "scene", "lamp": lamp})
    assert bool(bent_lamp(scene)) == bent
    assert not bent_lamp(load(renderer, {"type": "scene", "lamp": {"type": "rectangle", "emitter": {"type": "area"}}}))


def test_info_says_it_too(tmp_path):
    (tmp_path / "it.xml").write_text(SCENE.format(ball=GLASS, lamp=POINT))
    (line,) = (line for line in inspect_scene(str(tmp_path / "it.xml"))["plan"] if line.startswith("caustics of lamps"))
    assert "`--sampler vcm`" in line
    (tmp_path / "it.xml").write_text(SCENE.format(ball="", lamp=POINT))
    assert not any(line.startswith("caustics of lamps") for line in inspect_scene(str(tmp_path / "it.xml"))["plan"])
