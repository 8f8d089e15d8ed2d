"""Crops whose inputs have uneven samples: those of the adaptive sampler, beside the same views and references."""

import numpy as np
import pytest
from unbiased import load

from ngpt.training.dataset import Dataset, problems

pytest.importorskip("mitsuba")
pytest.importorskip("safetensors")


@pytest.fixture
def around(renderer):
    """A dim box with one bright corner, where the noise is."""
    from data_gen.dataset.cameras import Surroundings

    mi = renderer
    t = mi.ScalarTransform4f
    walls = {
        f"wall{i}": {"type": "rectangle", "to_world": t().rotate([0, 1, 0], 90 * i).translate([0, 0, -4]).scale(4)}
        for i in range(4)
    }
    scene = {
        "type": "scene",
        "camera": {"type": "thinlens", "fov": 60, "aperture_radius": 0.01, "focus_distance": 4.0},
        "lamp": {"type": "sphere", "radius": 0.3, "center": [2, 1, 2], "e": {"type": "area", "radiance": 9.0}},
        "box": {"type": "cube", "to_world": t().translate([1, 0, 1]).scale(0.7)},
        **walls,
    }
    return Surroundings(load(mi, scene))


def config_of(**changes):
    from data_gen.dataset.config import Config

    settings = {"size": 16, "inputs": 2, "spp": (32, 64), "sampler": "primal", "reference_method": "primal"}
    return Config(**(settings | {"scenes": 1, "reference_spp": 4, "roll": 0.0} | changes))


def test_uneven_inputs_beside_the_same_views_seeds_and_references(renderer, around):
    from data_gen.dataset.crops import make_crop
    from ngpt.merging import merge

    ((even, told),) = make_crop(config_of(), around, "x", 0)
    ((uneven, told_uneven),) = make_crop(config_of(adaptive=1.0), around, "x", 0)
    assert "adaptive" not in told and told_uneven["adaptive"] == [True, True]
    assert told_uneven["seeds"] == told["seeds"] and told_uneven["view"] == told["view"]
    assert np.array_equal(uneven.reference, even.reference)
    for spp, before, stack in zip(even.spp, even.stacks, uneven.stacks, strict=True):
        assert "samples" not in before
        samples = stack["samples"]
        assert samples.min() >= 16 and np.ptp(samples) > 0 and np.all(samples % 16 == 0)
        assert spp - 16 < samples.mean() <= spp
        # A pixel with n samples has the primal of an even render with n: those that got just as many as before do.
        assert not np.array_equal(stack["primal"], before["primal"])
    # Stacks of both kinds merge: the layer is what it is in rendered stacks.
    assert merge(uneven.stacks)["samples"].sum() == sum(stack["samples"].sum() for stack in uneven.stacks)


def test_the_share_of_uneven_inputs(renderer):
    """By random numbers of their own; too few samples stay even."""
    from data_gen.dataset.crops import uneven_inputs

    config = config_of(adaptive=0.25, spp=(2, 64))
    drawn = [uneven_inputs(config, "x", crop, [31, 32, 64]) for crop in range(400)]
    assert drawn == [uneven_inputs(config, "x", crop, [31, 32, 64]) for crop in range(400)]
    few, *enough = np.mean(drawn, axis=0)
    assert few == 0
    # Standard deviation of a mean of 400: 0.022
    assert all(abs(share - 0.25) < 4 * 0.022 for share in enough)
    assert uneven_inputs(config_of(), "x", 0, [32, 64]) == [False, False]


def test_a_set_of_both_kinds(renderer, around, tmp_path, monkeypatch):
    """All inputs have the layer then, so that crops of either kind fit into one shard, and are read back."""
    from data_gen.dataset import cameras, crops, jobs
    from data_gen.scenes import load

    monkeypatch.setattr(cameras, "Surroundings", lambda scene, box: around)
    monkeypatch.setattr(load, "load_scene", lambda *arguments, merged: None)
    monkeypatch.setattr(crops, "made_scene", lambda *arguments: None)
    monkeypatch.setattr(crops, "uneven_inputs", lambda config, name, crop, counts: [False, crop == 1])
    jobs.generate(config_of(adaptive=0.5, crops=2), tmp_path, jobs.Serial())
    assert problems(tmp_path) == []
    data = Dataset(tmp_path)
    spread = [[float(np.ptp(crop.stack(k)["samples"])) for k in range(2)] for crop in data]
    assert [[s > 0 for s in row] for row in spread] == [[False, False], [False, True]]
    for crop in data:
        assert crop.stack(0)["samples"].shape == (16, 16, 1)
        assert np.all(crop.stack(0)["samples"] == crop.spp[0])
