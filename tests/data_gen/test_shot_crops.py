"""Shots of training sets: what moves, moves as its motion says, and the scene is left as it was."""

from itertools import pairwise

import numpy as np
import pytest
from unbiased import load

from ngpt.sequence.warp import warped

pytest.importorskip("mitsuba")

FRAMES = 3


@pytest.fixture
def around(renderer):
    from data_gen.dataset.cameras import Surroundings

    mi = renderer
    t = mi.ScalarTransform4f

    def painted(seed):
        pixels = np.random.default_rng(seed).random((5, 5, 3)).astype(np.float32)
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
        return {"type": "diffuse", "reflectance": texture}

    walls = {
        f"wall{i}": {"type": "rectangle", "to_world": t().rotate([0, 1, 0], 90 * i).translate([0, 0, -4]).scale(4)}
        | {"paint": painted(i)}
        for i in range(4)
    }
    scene = {
        "type": "scene",
        "camera": {"type": "thinlens", "fov": 60, "aperture_radius": 0.01, "focus_distance": 4.0},
        "sky": {"type": "constant", "radiance": 0.3},
        "lamp": {"type": "sphere", "radius": 0.3, "center": [0, 3, 0], "e": {"type": "area", "radiance": 9.0}},
        "box": {"type": "cube", "to_world": t().translate([1, 0, 1]).scale(0.7), "paint": painted(9)},
        **walls,
    }
    return Surroundings(load(mi, scene))


def config_of(**changes):
    from data_gen.dataset.config import Config

    settings = {"size": 24, "inputs": 1, "spp": (2, 2), "sampler": "primal", "reference_method": "primal"}
    return Config(**(settings | {"frames": FRAMES, "scenes": 1, "reference_spp": 4, "roll": 0.0} | changes))


def state(mi, scene):
    """All that can be moved or shine, but the camera."""
    from data_gen.scenes.geometry import VERTICES

    params = mi.traverse(scene)
    kinds = (".to_world", *(f".{name}" for name in VERTICES), ".value", ".radiance.value")
    names = [name for name in params.keys() if name.endswith(kinds) and "camera" not in name]  # noqa: SIM118
    return {name: np.array(getattr(params[name], "matrix", params[name])) for name in names}


def test_what_is_seen_was_seen_there_and_the_scene_stays(renderer, around, monkeypatch):
    """Colours of the frame before, along motion, are those of this one, but for edges."""
    from data_gen.dataset import movement
    from data_gen.dataset.crops import make_crop

    for share in ("CAMERA", "THING", "LIGHT"):
        monkeypatch.setattr(movement, share, 1.0)
    before = state(renderer, around.scene)
    moved, kinds = [], set()
    for crop in range(4):
        made = make_crop(config_of(), around, "x", crop)
        assert [told["frame"] for _, told in made] == list(range(FRAMES))
        assert np.isnan(made[0][0].motion).all()
        what = made[0][1]["movement"]
        kinds |= {kind for kind in ("shape", "light") if what[kind]}
        for (last, _), (now, _) in pairwise(made):
            colours, found = warped(last.stacks[0]["albedo"], now.motion)
            if found.mean() > 0.3:
                difference = np.abs(colours - now.stacks[0]["albedo"]).max(axis=-1)[found]
                assert np.median(difference) < 0.03
                moved.append(float(np.nanmedian(np.linalg.norm(now.motion, axis=-1))))
    assert kinds == {"shape", "light"} and len(moved) >= 4 and max(moved) > 4 * min(moved)
    after = state(renderer, around.scene)
    assert all(np.allclose(after[name], value, atol=1e-6) for name, value in before.items())


def test_one_frame_is_the_crop_it_was(renderer, around):
    """No random number more is drawn, and nothing of shots is recorded."""
    from data_gen.dataset.cameras import find_view
    from data_gen.dataset.crops import make_crop, scene_seed
    from data_gen.render import render_stack

    config = config_of(frames=1)
    ((data, told),) = make_crop(config, around, "x", 3)
    assert data.motion is None and not {"frame", "movement"} & told.keys()
    rng = np.random.default_rng((*scene_seed(config, "x"), 3))
    rng.random()  # of the number of samples
    view = find_view(around, rng, config.size, config.roll, config.lens)
    view.apply(around.scene)
    seed = int(rng.integers(0, 2**32, 3)[0])
    assert told["view"] == view.record() and told["seeds"][0] == seed
    assert np.array_equal(data.stacks[0]["primal"], render_stack(around.scene, 2, seed, "primal")["primal"])


def test_a_set_of_shots(renderer, around, tmp_path, monkeypatch):
    from data_gen.dataset import cameras, crops, jobs
    from data_gen.scenes import load
    from ngpt.training.dataset import Dataset, problems

    monkeypatch.setattr(cameras, "Surroundings", lambda scene, box: around)
    monkeypatch.setattr(load, "load_scene", lambda *arguments, merged: None)
    monkeypatch.setattr(crops, "made_scene", lambda *arguments: None)
    jobs.generate(config_of(size=16, crops=2), tmp_path, jobs.Serial())
    data = Dataset(tmp_path)
    assert data.shots == (range(3), range(3, 6)) and data.manifest["planned"] == 6 and problems(tmp_path) == []
    from data_gen.dataset.card import write_card

    write_card(tmp_path)
    assert "2 shots of up to 3 frames: 6 crops of 16x16 pixels" in (tmp_path / "README.md").read_text()
