"""From scenes to stacks: loading, sizes, variants, and what goes wrong."""

import numpy as np
import pytest

import ngpt
from ngpt.errors import NgptError
from ngpt.windows import Place, Window

pytest.importorskip("mitsuba")

from data_gen.backend import use_variant
from data_gen.inspect import inspect_scene
from data_gen.render import render_stack
from data_gen.scenes.cameras import place_of
from data_gen.scenes.load import load_scene

SCENE = """<scene version="3.0.0">
  <default name="resx" value="40"/> <default name="depth" value="3"/>
  <integrator type="{integrator}"><integer name="max_depth" value="$depth"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="30"/>{film}</film>
  </sensor>
  <shape type="sphere"><bsdf type="{bsdf}"/></shape>
  <emitter type="constant"/>
</scene>"""


PLAIN = {"integrator": "path", "film": "", "bsdf": "diffuse"}


@pytest.fixture
def scene_file(renderer, tmp_path):
    def write(text=SCENE, **changes):
        path = tmp_path / "scene.xml"
        path.write_text(text.format(**PLAIN | changes) if text is SCENE else text)
        return str(path)

    return write


def crop(*window):
    names = ("offset_x", "offset_y", "width", "height")
    return "".join(f'<integer name="crop_{n}" value="{v}"/>' for n, v in zip(names, window, strict=True))


@pytest.mark.parametrize(
    ("size", "window", "expected"),
    [
        ((80, 60), (10, 5, 20, 15), (20, 10, 40, 30)),
        ((20, 15), (10, 5, 20, 15), (5, 3, 10, 7)),  # 2.5 and 10 become 3 and 10
        ((20, 15), (0, 0, 10, 5), (0, 0, 5, 3)),  # which meets it
        ((20, 15), (20, 15, 20, 15), (10, 8, 10, 7)),
        ((4, 3), (39, 29, 1, 1), (3, 2, 1, 1)),
        ((20, 15), (0, 0, 40, 30), (0, 0, 20, 15)),
    ],
)
def test_a_crop_window_stays_the_same_part_of_a_film_of_another_size(scene_file, size, window, expected):
    scene = load_scene(scene_file(film=crop(*window)), size)
    assert place_of(scene.sensors()[0]) == Place(Window(*expected), Window(0, 0, *size))


def test_crops_keep_their_place_whatever_renders_them(scene_file, command):
    """By the command, with diagnostics and samples shared out."""
    scene, gpt = scene_file(film=crop(20, 10, 20, 20)), "--sampler gpt --spp 16 -o"
    for more in ("--diagnostics", "--adaptive --for wcv --spp 32", "--time 2"):
        command(f"render {scene} {gpt} part.exr --force {more}")
        assert ngpt.read("part.exr").place == Place(Window(20, 10, 20, 20), Window(0, 0, 40, 30)), more
    command(f"render {scene_file()} {gpt} whole.exr")
    command("diff part.exr whole.exr --tolerance 0.5")


def test_paths_are_the_same_with_and_without_features(scene_file):
    scene = load_scene(scene_file(), (17, 5))
    bare, full = (render_stack(scene, 4, 0, "primal", with_features=flag, unbiased=True) for flag in (False, True))
    assert set(full.names) - set(bare.names) == {"direct", "albedo", "normal", "depth"}
    # Each sample has four rays for features, and they may meet lamps that its path misses. So only those pixels count
    # where all rays meet a lamp, or none.
    even = np.isin(full["direct"], (0, 1)).all(axis=-1)
    assert 0.5 < even.mean() < 1
    assert np.allclose(bare["primal"][even], full["primal"][even], rtol=1e-5)
    with pytest.raises(NgptError, match="sampler 'gpt' has no option 'features'"):
        render_stack(scene, 4, 0, "gpt", with_features=False, unbiased=True)


def test_attributes_tell_how_it_was_made(renderer):
    attributes = render_stack(load_scene("lens", (8, 8)), 3, seed=2**63, sampler="gpt", unbiased=True).attributes
    assert attributes["ngpt:spp"] == 3 and attributes["ngpt:seed"] == str(2**63)
    assert attributes["ngpt:sampler"] == "gpt" and attributes["ngpt:normalSpace"] == "camera"
    assert attributes["ngpt:seconds"] > 0 and attributes["ngpt:discarded"] == 0


def means(spp=256):
    stack = render_stack(load_scene("lens", (12, 8)), spp, gradients=True, unbiased=True)
    return {name: stack[name].mean(axis=(0, 1)) for name in stack.names}


@pytest.fixture(scope="module")
def expected(renderer):
    return means()


# ``laws`` has variants that are not polarized.
@pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test_polarized_variants_render_the_same_image(expected, variant):
    use_variant(variant)
    try:
        found = means()
    finally:
        use_variant("llvm_ad_rgb")
    assert found.keys() == expected.keys()
    # Mono keeps only the luminance; colours that leave and re-enter RGB by a spectrum change a little. Of lamps out of
    # focus the sampler of polarised light takes one ray where others take four: a fifth is its standard deviation.
    for name, rel in {"primal": 0.1, "albedo": 0.1, "direct": 0.3}.items():
        weights = [0.2126, 0.7152, 0.0722]
        assert np.dot(found[name], weights) == pytest.approx(np.dot(expected[name], weights), rel=rel), name
    assert np.allclose(found["normal"], expected["normal"], atol=0.02)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<scene version='3.0.0'><shape", "scene.xml: Mitsuba cannot load it"),
        ("<scene version='3.0.0'/>", "the scene has no sensor"),
        ("<bsdf version='3.0.0' type='diffuse'/>", "not a whole scene"),
    ],
)
def test_scene_files_that_cannot_be_loaded(scene_file, text, message):
    with pytest.raises(NgptError, match=message) as error:
        load_scene(scene_file(text=text))
    assert "\n" not in str(error.value)


def test_built_in_scenes_have_no_parameters(renderer):
    with pytest.raises(NgptError, match="built-in scene 'diffuse' has no parameters"):
        load_scene("diffuse", parameters={"a": "1"})


def test_inspection_names_what_matters(scene_file):
    report = inspect_scene(scene_file(bsdf="dielectric"), {"resx": "50"})
    assert report["size"] == (50, 30)
    assert report["plugins"]["bsdf"] == {"dielectric": 1} and report["plugins"]["emitter"] == {"constant": 1}
    assert any("clear glass" in line for line in report["plan"])
    # Its light is a sky: photons are better, not the only way.
    assert any("found best by photons: `--sampler ppm`" in line and "gpm" not in line for line in report["plan"])
    assert any("both ends in one: `--sampler vcm`" in line and "gvcm" not in line for line in report["plan"])
    assert not any("photons" in line for line in inspect_scene("diffuse")["plan"])
    assert "thinlens" in inspect_scene("lens")["plugins"]["sensor"]
    flat = inspect_scene(scene_file(text=SCENE.replace("perspective", "orthographic").format(**PLAIN)))["plan"]
    assert [line.split(":")[0] for line in flat if "light paths cannot reach" in line] == ["refused by bdpt, vcm"]
    with pytest.raises(NgptError, match="not a scene Mitsuba can read"):
        inspect_scene(scene_file(text="<scene"))


def test_inspection_of_media_lens_maps_and_shutter(scene_file):
    fog = '<medium type="homogeneous" name="interior" id="mist"/>'
    text = SCENE.format(**PLAIN | {"integrator": "volpath"}).replace("</shape>", f"{fog}</shape>")
    text = text.replace("<film", '<float name="shutter_close" value="0.5"/><film').replace('="constant"', '="point"')
    report = inspect_scene(scene_file(text=text))
    assert report["media"] == ["mist"] and report["shutter"] == 0.5 and not report["lens"]
    assert report["sampler"] == "primal"
    plan = "\n".join(report["plan"])
    assert "media: albedo counts them" in plan and "refused by bdpt" in plan
    assert "nothing moves" in plan and "'direct' layer" not in plan
    assert "small lights in media: the paths of the default find their beams" in plan and "glass" not in plan
    through_glass = "\n".join(inspect_scene(scene_file(text=text.replace('"diffuse"', '"dielectric"')))["plan"])
    assert "found by photons alone for lights without size: `--sampler bre`" in through_glass
    assert "both ends" not in through_glass  # which see no media
    report = inspect_scene("lens")
    # What `ngpt render` does: nothing that holds for other scenes or samplers only.
    assert (report["sampler"], report["method"]) == ("primal", "oidn")
    assert not any("in a room" in line or line.startswith("transport") for line in report["plan"])
    assert report["lens"] and "depth of field" in "\n".join(report["plan"])
