"""From scenes to stacks: loading, sizes, variants, and what goes wrong."""

import numpy as np
import pytest

import ngpt
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.measure.metrics import relmse
from ngpt.windows import Place, Window

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


@pytest.fixture
def scene_file(renderer, tmp_path):
    def write(integrator="path", film="", bsdf="diffuse", text=SCENE):
        path = tmp_path / "scene.xml"
        path.write_text(text.format(integrator=integrator, film=film, bsdf=bsdf) if text is SCENE else text)
        return str(path)

    return write


def test_scene_file_with_its_own_size_a_given_size_and_parameters(scene_file):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    assert render_stack(load_scene(scene_file()), 1)["primal"].shape == (30, 40, 3)
    assert render_stack(load_scene(scene_file(), parameters={"resx": "20"}), 1)["primal"].shape == (30, 20, 3)
    assert render_stack(load_scene(scene_file(), (17, 5)), 1)["primal"].shape == (5, 17, 3)


def crop(*window):
    names = ("offset_x", "offset_y", "width", "height")
    return "".join(f'<integer name="crop_{n}" value="{v}"/>' for n, v in zip(names, window, strict=True))


def test_crop_window_shows_its_part_of_the_image(scene_file):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    whole = render_stack(load_scene(scene_file()), 512)
    part = render_stack(load_scene(scene_file(film=crop(10, 5, 20, 15))), 512)
    assert part.place == Place(Window(10, 5, 20, 15), whole.place.data)
    assert part["depth"].shape == (15, 20, 1)
    assert np.abs(part["depth"] - whole["depth"][5:20, 10:30]).mean() < 0.02
    assert np.abs(part["dx"][:, :-1] - whole["dx"][5:20, 10:29]).mean() < 0.01


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
    from data_gen.scenes.cameras import place_of
    from data_gen.scenes.load import load_scene

    scene = load_scene(scene_file(film=crop(*window)), size)
    assert place_of(scene.sensors()[0]) == Place(Window(*expected), Window(0, 0, *size))


def test_crops_keep_their_place_whatever_renders_them(scene_file, tmp_path):
    """By the command, with diagnostics and samples shared out; and what it shows is that part."""
    place = Place(Window(20, 10, 20, 20), Window(0, 0, 40, 30))
    scene, whole, out = scene_file(film=crop(20, 10, 20, 20)), tmp_path / "whole.xml", str(tmp_path / "part.exr")
    whole.write_text(SCENE.format(integrator="path", film="", bsdf="diffuse"))
    for more in (["--diagnostics"], ["--adaptive", "--for", "wcv", "--spp", "32"], ["--time", "2"]):
        command = ["render", scene, "--sampler", "gpt", "--spp", "16", "-o", out, "--force", *more]
        assert main(command) == 0
        assert ngpt.read(out).place == place, more
    assert main(["render", str(whole), "--sampler", "gpt", "--spp", "16", "-o", str(tmp_path / "whole.exr")]) == 0
    there = place.data.within(place.display)
    part, image = ngpt.read(out), ngpt.read(tmp_path / "whole.exr")
    assert np.abs(part["depth"] - image["depth"][there]).mean() < 0.1
    assert main(["diff", out, str(tmp_path / "whole.exr"), "--tolerance", "0.5"]) == 0


def test_tiles_of_an_image_are_merged_to_what_is_rendered_at_once(scene_file, tmp_path):
    files, whole = [], tmp_path / "whole.exr"
    for i, window in enumerate([(0, 0, 21, 16), (20, 0, 20, 16), (0, 15, 21, 15), (20, 15, 20, 15)]):
        files.append(str(tmp_path / f"tile{i}.exr"))
        command = ["render", scene_file(film=crop(*window)), "--sampler", "gpt", "--seed", str(i), "--spp", "64"]
        assert main([*command, "-o", files[-1]]) == 0
    assert main(["merge", *files, "-o", str(tmp_path / "merged.exr")]) == 0
    assert main(["render", scene_file(), "--sampler", "gpt", "--spp", "64", "--seed", "9", "-o", str(whole)]) == 0
    merged, image = ngpt.read(tmp_path / "merged.exr"), ngpt.read(whole)
    assert merged.place == image.place and merged["samples"].max() == 4 * 64
    assert np.isfinite(merged["dx"]).all() and np.isfinite(merged["dy"]).all()
    for name in ("primal", "dx", "dy"):
        scale = np.sqrt(merged[f"{name}_var"] + image[f"{name}_var"])
        z = np.divide(merged[name] - image[name], scale, where=scale > 0, out=np.zeros_like(scale))
        assert np.sqrt(np.square(z).mean()) < 1.3, name
    results = [ngpt.denoise(stack, method="l1") for stack in (merged, image)]
    assert relmse(*results) < 0.01


def test_paths_alone_are_those_with_features(scene_file):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(scene_file(), (17, 5))
    bare, full = (render_stack(scene, 4, 0, "primal", with_features=flag) for flag in (False, True))
    assert set(full.names) - set(bare.names) == {"direct", "albedo", "normal", "depth"}
    # A pixel's four rays a sample meet lamps that its path alone does not, but not where they meet none, or one evenly.
    even = np.isin(full["direct"], (0, 1)).all(axis=-1)
    assert 0.5 < even.mean() < 1
    assert np.allclose(bare["primal"][even], full["primal"][even], rtol=1e-5)
    with pytest.raises(NgptError, match="sampler 'gpt' always renders features"):
        render_stack(scene, 4, 0, "gpt", with_features=False)


def test_attributes_tell_how_it_was_made(renderer):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    attributes = render_stack(load_scene("lens", (8, 8)), 3, seed=2**63).attributes
    assert attributes["ngpt:spp"] == 3 and attributes["ngpt:seed"] == str(2**63)
    assert attributes["ngpt:sampler"] == "gpt" and attributes["ngpt:normalSpace"] == "camera"
    assert attributes["ngpt:seconds"] > 0 and attributes["ngpt:discarded"] == 0


@pytest.mark.parametrize(
    "variant", ["llvm_ad_mono", "llvm_ad_mono_polarized", "llvm_ad_spectral", "llvm_ad_spectral_polarized"]
)
def test_every_kind_of_variant_renders_the_same_image(renderer, variant):
    from data_gen.backend import use_variant

    def mean(spp):
        from data_gen.render import render_stack
        from data_gen.scenes.load import load_scene

        stack = render_stack(load_scene("lens", (12, 8)), spp)
        return {name: stack[name].mean(axis=(0, 1)) for name in stack.names}

    expected = mean(256)
    use_variant(variant)
    try:
        found = mean(256)
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
    ("arguments", "message"),
    [
        ({"name": "missing.xml"}, "missing.xml: no such file, nor a built-in scene; those are: diffuse"),
        ({"name": "diffuse", "parameters": {"a": "1"}}, "built-in scene 'diffuse' has no parameters"),
    ],
)
def test_scenes_that_are_not_there(renderer, arguments, message):
    from data_gen.scenes.load import load_scene

    with pytest.raises(NgptError, match=message):
        load_scene(**arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bsdf": "nonsense"}, 'scene.xml: Mitsuba cannot load it: .*"nonsense" not found'),
        ({"text": "<scene version='3.0.0'><shape"}, "scene.xml: Mitsuba cannot load it"),
        ({"text": "<scene version='3.0.0'/>"}, "the scene has no sensor"),
        ({"text": "<bsdf version='3.0.0' type='diffuse'/>"}, "not a whole scene"),
    ],
)
def test_scene_files_that_cannot_be_loaded(scene_file, options, message):
    from data_gen.scenes.load import load_scene

    with pytest.raises(NgptError, match=message) as error:
        load_scene(scene_file(**options))
    assert "\n" not in str(error.value)


def test_variants_that_do_not_exist(renderer):
    from data_gen.backend import use_variant

    for name in ("scalar_rgb", "llvm_rgb"):
        with pytest.raises(NgptError, match=f"'{name}' is not one .*llvm_ad_rgb"):
            use_variant(name)


def test_inspection_names_what_matters(scene_file):
    from data_gen.inspect import inspect_scene

    report = inspect_scene(scene_file(bsdf="dielectric"), {"resx": "50"})
    assert report["size"] == (50, 30)
    assert report["plugins"]["bsdf"] == {"dielectric": 1} and report["plugins"]["emitter"] == {"constant": 1}
    assert any("clear glass" in line for line in report["plan"])
    # Its light is a sky: photons are better, not the only way.
    assert any("found best by photons: `--sampler ppm`, `--sampler gpm`" in line for line in report["plan"])
    assert any("both ends in one: `--sampler vcm`, `--sampler gvcm`" in line for line in report["plan"])
    assert not any("photons" in line for line in inspect_scene("diffuse")["plan"])
    assert "thinlens" in inspect_scene("lens")["plugins"]["sensor"]
    with pytest.raises(NgptError, match="not a scene Mitsuba can read"):
        inspect_scene(scene_file(text="<scene"))


def test_inspection_of_media_lens_maps_and_shutter(scene_file):
    from data_gen.inspect import inspect_scene

    fog = '<medium type="homogeneous" name="interior" id="mist"/>'
    text = SCENE.format(integrator="volpath", film="", bsdf="diffuse").replace("</shape>", f"{fog}</shape>")
    text = text.replace("<film", '<float name="shutter_close" value="0.5"/><film').replace('="constant"', '="point"')
    report = inspect_scene(scene_file(text=text))
    assert report["media"] == ["mist"] and report["shutter"] == 0.5 and not report["lens"]
    assert report["sampler"] == "gpt"
    plan = "\n".join(report["plan"])
    assert "media: offset paths join where light scatters" in plan and "refused by gbdpt" in plan
    assert "nothing moves" in plan and "'direct' layer" not in plan
    assert "small lights in media: paths find their beams" in plan and "glass" not in plan
    through_glass = "\n".join(inspect_scene(scene_file(text=text.replace('"diffuse"', '"dielectric"')))["plan"])
    assert "found by photons alone for lights without size: `--sampler bre`" in through_glass
    assert "both ends" not in through_glass  # which see no media
    report = inspect_scene("lens")
    assert report["lens"] and "depth of field" in "\n".join(report["plan"])
