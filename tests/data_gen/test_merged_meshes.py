"""Scene files whose meshes are merged by material, against the same files as they are."""

import subprocess
import sys

import numpy as np
import pytest
from ply_files import square

from data_gen.scenes.load import load_scene
from ngpt.errors import NgptError

SCENE = """<scene version="3.0.0"><integrator type="volpath"/><emitter type="constant"/>
<sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">
<lookat origin="2,1,9" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="12"/></film></sensor>{}</scene>"""


def wall(x: float, smooth: bool = False) -> str:
    """A square of a side of 1 at ``x``, whose corners have normals of their own or none."""
    corners = [(x, -0.5, 0), (x + 1, -0.5, 0), (x + 1, 0.5, 0), (x, 0.5, 0)]
    return square(corners, 4 * [(0.1, 0, 0.995)] if smooth else ())


def shape(name: str, inside: str) -> str:
    return f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>{inside}</shape>'


def bsdf(name: str, color: str) -> str:
    return f'<bsdf type="diffuse" id="{name}"><rgb name="reflectance" value="{color}"/></bsdf>'


@pytest.fixture
def scene_file(tmp_path):
    """Meshes of two materials: of red two flat ones and a smooth one, of green two, a lamp, and the bounds of fog."""
    red, green = '<ref id="red"/>', '<ref id="green"/>'
    lamp = red + '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'
    fog = green + '<medium type="homogeneous" name="interior"/>'
    inside = {"a": red, "b": green, "c": red, "lamp": lamp, "smooth": red, "d": green, "fog": fog}
    for i, name in enumerate(inside):
        (tmp_path / f"{name}.ply").write_text(wall(1.2 * i - 4.2, name == "smooth"))
    shapes = "".join(shape(name, text) for name, text in inside.items())
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(f"{bsdf('red', '.7,.2,.2')}{bsdf('green', '.2,.7,.2')}{shapes}"))
    return path


def views(mi, scene):
    """What the camera sees: normals, texture coordinates, depths and colours; the first channel is the normal's x."""
    integrator = mi.load_dict({"type": "aov", "aovs": "n:sh_normal,g:geo_normal,u:uv,d:depth,a:albedo"})
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=1))


def test_meshes_of_one_material_are_one(renderer, scene_file):
    merged = load_scene(str(scene_file))
    plain = load_scene(str(scene_file), merged=False)
    assert [s.id() for s in plain.shapes()] == ["a", "b", "c", "lamp", "smooth", "d", "fog"]
    assert sum(s.primitive_count() for s in merged.shapes()) == 14
    # Where corners have normals of their own, others of that material have none to take.
    assert len(merged.shapes()) in (4, 5)
    kept = [s for s in merged.shapes() if s.id() in ("lamp", "fog")]
    assert kept[0].is_emitter() and kept[1].is_medium_transition() and len(merged.emitters()) == 2
    before, after = views(renderer, plain), views(renderer, merged)
    # The smooth one turns its normal, the flat ones do not.
    assert 0.01 < (np.abs(before[..., 0]) > 0.05).mean() < 0.3
    assert np.allclose(before, after, atol=1e-5)


def inline(x, kind="cube", color=".7,.2,.2", more=""):
    """A shape with a material of its own, as exporters write it; one that is turned shows its sides."""
    place = f'<transform name="to_world"><scale value=".4"/><rotate y="1" angle="30"/><translate x="{x}"/></transform>'
    return f'<shape type="{kind}"><bsdf type="twosided">{bsdf(f"m{x}", color)}</bsdf>{place}{more}</shape>'


def test_equal_materials_are_one_and_shapes_keep_the_order_of_the_file(renderer, tmp_path):
    path, green = tmp_path / "scene.xml", ".2,.7,.2"
    lamp = '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'
    shapes = [inline(-4), inline(-3, color=green), inline(-2, "rectangle"), inline(-1, "sphere"), inline(0)]
    shapes += [inline(1, "rectangle", green), inline(2, more=lamp), inline(3, "rectangle"), inline(4, color="0,0,.1")]
    path.write_text(SCENE.format("".join(shapes)))
    images = []
    for merged in (True, False):
        scene = load_scene(str(path), merged=merged)
        assert np.allclose(scene.bbox().min, (-4.546, -0.4, -0.546), atol=1e-3)
        images.append(views(renderer, scene))
        if merged:
            # Red: two cubes and two rectangles. Green: a cube and a rectangle. The sphere, the lamp, the last cube
            assert [shape.primitive_count() for shape in scene.shapes()] == [28, 14, 1, 12, 12]
    assert images[0][..., 0].max() > 0 and np.allclose(*images, atol=1e-5)


def test_many_meshes_are_merged_in_pairs(renderer, tmp_path, monkeypatch):
    """Each is copied as often as they can be halved. One after the other, the time grows with the square."""
    from data_gen.scenes import merge

    (tmp_path / "it.ply").write_text(wall(0))
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(bsdf("red", ".7,.2,.2") + 33 * shape("it", '<ref id="red"/>').replace(' id="it"', "")))
    halves, known = [], merge._in_pairs

    def spied(state, meshes):
        halves.append(len(meshes))
        return known(state, meshes)

    monkeypatch.setattr(merge, "_in_pairs", spied)
    (only,) = load_scene(str(path)).shapes()
    assert only.primitive_count() == 66
    assert sorted(halves) == sorted([1] * 33 + [2] * 16 + [3] + [4] * 7 + [5] + [8] * 3 + [9, 16, 17, 33])


GROUP = """<shape type="shapegroup" id="group">{}</shape>
<shape type="instance"><ref id="group"/><transform name="to_world"><translate x="-3"/></transform></shape>
<shape type="instance"><ref id="group"/><transform name="to_world"><rotate y="1" angle="40"/><scale x="2"/></transform>
</shape>"""


def test_instances_of_small_groups_are_meshes(renderer, tmp_path, monkeypatch):
    """And so they share the shape of their material, which is recorded once, not once for each."""
    path = tmp_path / "scene.xml"
    (tmp_path / "it.ply").write_text(wall(0.5, smooth=True))
    smooth = shape("it", bsdf("green", ".2,.7,.2"))
    path.write_text(SCENE.format(GROUP.format(inline(0) + smooth) + inline(3)))
    images = []
    for merged, kinds in ((True, ["Mesh", "Mesh"]), (False, ["Instance", "Instance", "Cube"])):
        scene = load_scene(str(path), merged=merged)
        assert [shape.class_name() for shape in scene.shapes()] == kinds
        images.append(views(renderer, scene))
    assert images[0][..., 0].max() > 0 and np.allclose(*images, atol=1e-4)
    ball = inline(1, "sphere")
    for inside, most in ((inline(0), 1000), (inline(0) + ball, 1 << 24)):
        monkeypatch.setattr("data_gen.scenes.merge._MOST_BYTES", most)
        path.write_text(SCENE.format(GROUP.format(inside)))
        assert [shape.class_name() for shape in load_scene(str(path)).shapes()] == ["Instance"] * 2


def test_a_scene_of_nothing_else_has_its_bounds(renderer, tmp_path):
    """Mitsuba loses the bounds of rectangles that it merges by itself, and with them the sky's sphere."""
    for i, name in enumerate("abc"):
        (tmp_path / f"{name}.ply").write_text(wall(1.2 * i))
    shapes = "".join(shape(name, '<ref id="red"/>') for name in "abc")
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(bsdf("red", ".7,.2,.2") + shapes))
    scene = load_scene(str(path))
    assert len(scene.shapes()) == 1
    assert np.allclose(scene.bbox().min, (0, -0.5, 0)) and np.allclose(scene.bbox().max, (3.4, 0.5, 0))


def test_the_order_is_that_of_the_file_in_every_process(scene_file):
    """And so are the numbers that Dr.Jit gives to shapes and materials: with others the kernel is another one."""
    code = (
        "import drjit as dr\n"
        "from data_gen.backend import use_variant; use_variant('llvm_ad_rgb')\n"
        "from data_gen.scenes.load import load_scene\n"
        f"scene = load_scene({str(scene_file)!r})\n"
        "import mitsuba as mi\n"
        "print([(s.primitive_count(), s.bbox().min[0]) for s in scene.shapes()])\n"
        "print([dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)) for s in scene.shapes()])\n"
        "print([dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(s.bsdf())) for s in scene.shapes()])"
    )
    pytest.importorskip("mitsuba")
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True) for _ in range(3)]
    assert runs[0].returncode == 0, runs[0].stderr
    assert len({run.stdout for run in runs}) == 1


def test_files_are_found_beside_their_scene_alone(renderer, scene_file, tmp_path):
    """A scene that was loaded before is not where the next one's meshes come from."""
    import mitsuba as mi

    before = list(mi.file_resolver())
    load_scene(str(scene_file))
    assert list(mi.file_resolver()) == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "scene.xml").write_text(scene_file.read_text())
    # Mitsuba loads several at a time, so the first that lacks is any of them.
    with pytest.raises(NgptError, match=r"\w\.ply"):
        load_scene(str(other / "scene.xml"))
    assert list(mi.file_resolver()) == before


def test_parameters_and_errors_are_those_of_mitsuba(renderer, scene_file):
    text = scene_file.read_text().replace(
        '<scene version="3.0.0">', '<scene version="3.0.0"><default name="n" value="48"/>'
    )
    scene_file.write_text(text.replace('value="48"/><integer name="height"', 'value="$n"/><integer name="height"'))
    assert load_scene(str(scene_file), parameters={"n": "20"}).sensors()[0].film().size()[0] == 20
    for merged in (True, False):
        with pytest.raises(NgptError, match="nosuch"):
            load_scene(str(scene_file), parameters={"nosuch": "1"}, merged=merged)
