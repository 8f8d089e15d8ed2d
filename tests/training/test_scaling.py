"""Errors over the number of crops and of steps."""

import itertools

import pytest

pytest.importorskip("torch")

from crops import SyntheticCrop

from bench.scaling import part, slope, table, train
from ngpt.training.settings import from_dict


def test_parts_are_whole_scenes_and_lie_within_each_other():
    crops = [SyntheticCrop(f"room-{i // 3}", i) for i in range(12)]
    parts = [part(crops, count, seed=1) for count in (2, 4, 12, 99)]
    assert [len(p) for p in parts] == [3, 6, 12, 12]
    for small, large in itertools.pairwise(parts):
        assert {id(crop) for crop in small} <= {id(crop) for crop in large}
    assert all(sum(c.scene == crop.scene for c in p) == 3 for p in parts for crop in p)
    assert [c.seed for c in part(crops, 3, seed=1)] != [c.seed for c in part(crops, 3, seed=2)]


def test_a_power_law_is_found_and_told():
    points = [(n, 0.3 * n**-0.25) for n in (10, 20, 80)]
    assert slope(points) == pytest.approx(-0.25)
    assert slope(points[:1]) is None
    assert "| -0.250 | 0.56 |" in table("crops", points)
    assert table("crops", points[:1]).splitlines()[-1].endswith("|  |  |")


def test_a_finished_run_is_read_and_not_trained_again(tmp_path):
    model = {"network": "dense", "channels": [4], "units": [1], "inputs": ["primal", "albedo"]}
    run = {"steps": 2, "batch": 1, "validate": 2}
    settings = from_dict({"model": model, "data": {"crop": 32}, "loss": {"kind": "l1"}, "run": run}, "a test")
    crops = [SyntheticCrop("a", 0), SyntheticCrop("b", 1)]
    error = train(settings, crops[:1], crops[1:], tmp_path)
    before = (tmp_path / "checkpoint.safetensors").stat().st_mtime_ns
    assert train(settings, crops[:1], crops[1:], tmp_path) == error > 0
    assert (tmp_path / "checkpoint.safetensors").stat().st_mtime_ns == before
