"""The sampler ``restir``: frames of a shot, resumed or not, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_shot import assert_sizes_may_not_change, assert_too_little_memory_is_refused_first

import data_gen
import ngpt
from data_gen.frames.camera_path import CameraPath, Key, look_at
from data_gen.samplers import FRAME_SAMPLERS, find
from data_gen.scenes.facts import Facts
from ngpt.cli import main
from ngpt.errors import NgptError

KEYS = [
    {"frame": 0, "origin": [0, 1.2, 4], "target": [0, 1, 0]},
    {"frame": 24, "origin": [2, 1, 3], "target": [0, 1, 0]},
]


def rendered(frames=range(3), spp=2, seed=7, size=(16, 12), describe=None, update=None, **options):
    """Stacks by their frames of a shot of the built-in scene, or of what ``describe`` (frame) says."""
    from data_gen.frames.shot import Shot

    views = [(np.array([key["origin"], key["target"], (0, 1, 0)], float), key["frame"]) for key in KEYS]
    path = CameraPath([Key(frame, look_at(*look), look) for look, frame in views])
    shot = Shot(describe or (lambda frame: ("diffuse", {})), size, path, update=update)
    return dict(data_gen.render_frames(shot, frames, spp, seed, sampler="restir", **options))


@pytest.fixture(scope="module")
def frames(renderer):
    return rendered()


def test_frames_have_all_layers(frames):
    assert {"primal", "direct", "dx", "dy", "albedo", "normal", "depth", "motion"} <= set(frames[2].names)
    assert {"primal_var", "dx_var", "dy_var"} <= set(frames[2].names)
    attributes = [stack.attributes for stack in frames.values()]
    assert [a["ngpt:sampler"] for a in attributes] == ["restir"] * 3
    confidence = [a["ngpt:confidence"] for a in attributes]
    assert confidence[0] == 1 and confidence[0] < confidence[1] < confidence[2] <= 3


def test_a_shot_is_gone_on_with_after_the_frames_before(frames):
    """With all frames before it, a frame has the same bits; they are not given."""
    later = rendered(skip=lambda frame: frame < 2)
    assert list(later) == [2]
    for name in ("primal", "dx", "dy_var", "motion"):
        assert np.array_equal(later[2][name], frames[2][name], equal_nan=True), name


def test_a_gap_is_bridged_by_so_many_frames_and_no_more(renderer, monkeypatch):
    monkeypatch.setitem(FRAME_SAMPLERS, "restir", replace(FRAME_SAMPLERS["restir"], warm_up=1))
    found = rendered(range(5), skip=lambda frame: frame in (1, 2, 3))
    confidence = {frame: stack.attributes["ngpt:confidence"] for frame, stack in found.items()}
    assert list(found) == [0, 4] and confidence[0] == 1 and 1 < confidence[4] <= 2


@pytest.mark.slow
def test_variances_are_those_over_seeds(renderer):
    """The law of the mean over chains; and differences are not half of themselves."""
    found = [rendered(range(2), spp=16, seed=seed)[1] for seed in range(6)]
    for name in ("dx", "dy"):
        over_seeds = np.var([stack[name] for stack in found], axis=0, ddof=1).mean()
        within = np.mean([stack[f"{name}_var"] for stack in found])
        assert 0.6 < within / over_seeds < 1.6, name
    edge = np.mean([stack["dx"] for stack in found], axis=0)
    image = np.mean([stack["primal"] - stack["direct"] for stack in found], axis=0)
    smooth = np.diff(image, axis=1)
    assert np.sum(edge[:, :-1] * smooth) / np.sum(smooth * smooth) == pytest.approx(1, abs=0.15)


def test_single_images_are_refused_and_why(renderer, tmp_path, capsys):
    with pytest.raises(NgptError, match=r"shots.*2 to 3 times as long.*--sampler gpt"):
        find("restir")
    assert main(["render", "diffuse", "--sampler", "restir", "-o", str(tmp_path / "x.exr")]) == 2
    assert "--frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 2.0}, "--spp"),
        ({"history": 0}, "'0' is not allowed; it takes a number of 1 or more"),
        ({"shift": "replay"}, "no option 'shift'"),
        ({"memory": 1}, "--memory"),
        ({"subpixels": 2}, "'restir' reuses earlier frames"),
    ],
)
def test_what_cannot_be_rendered_is_refused(renderer, options, message):
    with pytest.raises(NgptError, match=message):
        rendered(spp=4, size=(32, 24), **options)


def test_too_little_memory_is_refused_before_motion_is_computed(renderer, tmp_path, monkeypatch):
    assert_too_little_memory_is_refused_first(tmp_path, monkeypatch, "restir")


def test_crop_windows_are_of_one_size(renderer, tmp_path):
    assert_sizes_may_not_change(tmp_path, sampler="restir")


def test_what_is_refused_prints_a_line_and_leaves_nothing(renderer, command, tmp_path):
    told = command("render diffuse --frames 0:2 --sampler restir -o a.png --denoise wcv", 2).err
    assert "sampler 'restir' renders none" in told and not list(tmp_path.iterdir())


SCENE = """<scene version="3.0.0"><default name="power" value="1"/>
        <integrator type="path"><integer name="max_depth" value="4"/></integrator>
        <sensor type="perspective"><transform name="to_world"><lookat origin="0,1,4" target="0,1,0" up="0,1,0"/>
        </transform><film type="hdrfilm"><rfilter type="box"/></film></sensor>
        <shape type="rectangle"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
        <shape type="sphere"><point name="center" x="0" y="1" z="0"/><float name="radius" value="0.5"/></shape>
        <emitter type="constant"><rgb name="radiance" value="$power"/></emitter></scene>"""


def test_a_scene_that_is_loaded_anew_in_each_frame_keeps_its_history(renderer, tmp_path):
    """Frames resumed are the same bits, and light that doubles is followed at once."""
    file, powers = tmp_path / "scene.xml", ("1", "1", "2")
    file.write_text(SCENE)

    def found(**options):
        return rendered(spp=8, seed=0, describe=lambda frame: (str(file), {"power": powers[frame]}), **options)

    stacks = found()
    assert stacks[2].attributes["ngpt:confidence"] > 2
    light = [(stack["primal"] - stack["direct"]).mean() for stack in stacks.values()]
    assert light[2] / light[1] == pytest.approx(2, rel=0.05)
    later = found(skip=lambda frame: frame < 2)
    assert np.array_equal(later[2]["dx"], stacks[2]["dx"])


def test_media_are_refused():
    assert "media" in FRAME_SAMPLERS["restir"].refuses(Facts("path", ("fog",)))
    assert "volpath" in FRAME_SAMPLERS["restir"].refuses(Facts("volpath", ()))


def test_the_command_renders_a_shot_with_options(renderer, tmp_path):
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"keys": KEYS}))
    command = ["render", "diffuse", "--frames", "0:2", "--camera", str(path), "--sampler", "restir", "--size", "16x12"]
    assert main([*command, "-O", "gradients=after", "-o", str(tmp_path / "shot")]) == 0
    stack = ngpt.read(tmp_path / "shot" / "diffuse.0001.exr")
    assert stack.attributes["ngpt:sampler"] == "restir"
    assert stack.attributes["ngpt:samplerOptions"] == "gradients=after"
    assert stack.attributes["ngpt:spp"] == FRAME_SAMPLERS["restir"].spp
