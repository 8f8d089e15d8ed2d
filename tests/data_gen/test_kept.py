"""References kept small, their inputs rendered anew; pairs, which have none; plans that never end."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.training.dataset import Dataset, ShardCrop, problems

pytest.importorskip("safetensors")
pytest.importorskip("mitsuba")

from data_gen.dataset import crops, jobs, stream
from data_gen.dataset.card import write_card
from data_gen.dataset.config import DatasetConfig, Files
from data_gen.dataset.kept import Again, Kept, home, keep, packed, unpacked
from ngpt.training.shards import CropData, Shard, write_shard

SMALL = DatasetConfig(size=16, inputs=2, spp=(2, 4), scenes=1, crops=2, reference_spp=8)


def test_numbers_come_back_within_half_a_step(rng):
    image = (10.0 ** rng.uniform(-30, 30, (7, 9, 3)) * rng.choice([-1, 0, 1], (7, 9, 3))).astype(np.float32)
    back = unpacked(packed(image), image.shape[:2])
    np.testing.assert_allclose(back, image, rtol=2 ** (0.5 / 64) - 1 + 1e-5)
    assert np.array_equal(back == 0, image == 0) and back.dtype == np.float32


def test_images_become_small():
    """Smooth light takes less than a byte for each number, and what is black next to nothing."""
    y, x = np.mgrid[:64, :64] / 64
    image = (0.2 + np.sin(3 * x + 2 * y)[..., None] ** 2 * (1, 0.8, 0.5)).astype(np.float32)
    assert len(packed(image)) < 0.6 * image.size and len(packed(0 * image)) < 200


def test_damage_is_named():
    data = packed(np.ones((4, 4, 3), np.float32))
    for bad in (data[:-3], data[::-1].copy(), packed(np.ones((4, 5, 3), np.float32))):
        with pytest.raises(NgptError, match=r"x\.safetensors: is damaged"):
            unpacked(bad, (4, 4), "x.safetensors")


@pytest.fixture(scope="module")
def made(renderer, first_view, tmp_path_factory):
    """Makes the shard of a configuration, and reads its crops."""

    def make(config=SMALL, again=None):
        folder = tmp_path_factory.mktemp("set")
        (folder / "shards").mkdir()
        shard = Shard(folder / crops.make_shard(config, config.plan()[0], str(folder), "llvm_ad_rgb", again))
        return shard, [ShardCrop(shard, i, "made", tuple(told["spp"])) for i, told in enumerate(shard.record["crops"])]

    return make


@pytest.fixture(scope="module")
def first(made):
    return made()


def test_references_share_no_tails(made, first, small_images_share):
    """References stay the same to the bit where inputs share tails."""
    for paths, shared in zip(first[1], made(replace(SMALL, samplers={"gpt": {"tails": "shared"}}))[1], strict=True):
        assert np.array_equal(paths.reference, shared.reference)
        assert not np.array_equal(paths.stack(1)["primal"], shared.stack(1)["primal"])


def test_inputs_are_rendered_anew(made, first, tmp_path):
    """The reference and the view stay; the noise is another."""
    file = tmp_path / "kept.safetensors"
    keep(first[0], file)
    read = [first[1], *(made(again=Again(str(file), seed))[1] for seed in (1, 2))]
    assert len(Kept(file).places) == len(read[0]) == 2
    for one, *others in zip(*read, strict=True):
        for crop in others:
            # Light of the layer ``caustic`` may be negative here and there, and sums of both err by more than each.
            for name in ("reference_direct", "reference_caustic"):
                np.testing.assert_allclose(getattr(crop, name), getattr(one, name), rtol=0.01, atol=1e-4)
            np.testing.assert_allclose(crop.reference, one.reference, rtol=0.01, atol=1e-3)
            # What has next to no noise shows that the camera is the same.
            depths = [np.median(c.stack(1)["depth"]) for c in (one, crop)]
            assert depths[0] == pytest.approx(depths[1], rel=0.05)
        inputs = [crop.stack(1)["primal"] for crop in (one, *others)]
        assert not any(np.array_equal(inputs[i], inputs[i - 1]) for i in range(3))


def test_pairs(renderer, first_view, tmp_path):
    jobs.generate(replace(SMALL, reference_spp=0), tmp_path, jobs.Serial())
    write_card(tmp_path)
    assert problems(tmp_path) == [] and "No references" in (tmp_path / "README.md").read_text()
    for crop in Dataset(tmp_path):
        assert crop.paired and crop.spp[0] == crop.spp[1]
        a, b = (crop.stack(k) for k in range(2))
        assert not np.array_equal(a["primal"], b["primal"]) and np.all(a["dx_var"] >= 0)
        with pytest.raises(NgptError, match="is a pair: no reference"):
            _ = crop.reference


def test_plans_go_on_for_ever(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "scene.xml").touch()
    config = replace(SMALL, scenes=2, crops=3, crops_per_shard=2, files=(Files(str(tmp_path / "*/scene.xml"), 3),))
    plans = [config.plan(turn) for turn in range(3)]
    everything = [(job.scene, crop) for plan in plans for job in plan for crop in job.crops]
    assert len(set(everything)) == len(everything) == 27
    assert len({job.file for plan in plans for job in plan}) == 18
    assert ("made-00004", 0) in everything and ("a-scene", 8) in everything
    assert Path(plans[0][0].file).name == "made-00000-000.safetensors"


# ------------------------- The replay buffer, fed by a stand-in for rendering -------------------------


def until(condition):
    deadline = time.monotonic() + 20
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)


def stand_in(config, job, folder, variant, again=None):
    """One grey crop, as bright as its scene's number; its input is 1 brighter where the reference was kept."""
    number = int(job.scene[-5:])
    grey = np.full((8, 8, 3), number, np.float32)
    names = ("direct", "dx", "dy", "albedo", "normal", "primal_var", "dx_var", "dy_var")
    layers = {"primal": grey, "depth": grey[..., :1]} | dict.fromkeys(names, 0 * grey)
    stack = GradientStack(layers)
    crop = CropData([stack.replace(primal=grey + 1) if again else stack], [2], grey, 0 * grey)
    write_shard(Path(folder) / job.file, [crop], {"scene": job.scene, "crops": [{"spp": [2]}]})
    return job.file


def test_new_crops_replace_old_ones(monkeypatch):
    monkeypatch.setattr(stream, "make_shard", stand_in)
    config = DatasetConfig(scenes=1, crops=1)
    with ThreadPoolExecutor(2) as executor, stream.Stream(config, executor, capacity=4) as data:
        first = data[0]
        until(lambda: max(data.scenes) >= "made-00010")
        assert len(data) == 4 and max(data.scenes) >= "made-00010"
        assert first.scene not in data.scenes
        # It has left the buffer, but who holds it can still read it.
        assert np.all(first.reference == int(first.scene[-5:]))
        assert np.all(first.stack(0)["primal"] == int(first.scene[-5:]))


def test_kept_references_are_met_again_with_new_inputs(monkeypatch, tmp_path):
    monkeypatch.setattr(stream, "make_shard", stand_in)
    config = DatasetConfig(scenes=3, crops=1, size=8)
    with ThreadPoolExecutor(1) as executor, stream.Stream(config, executor, capacity=3, kept=tmp_path) as data:
        until(lambda: all(np.any(crop.stack(0)["primal"] != crop.reference) for crop in data))
        assert {crop.scene for crop in data} <= {"made-00000", "made-00001", "made-00002"}
        assert all(np.all(crop.stack(0)["primal"] == crop.reference + 1) for crop in data)
    assert len(list(tmp_path.rglob("*.safetensors"))) == 3
    # Another configuration has others, one with other inputs the same.
    places = [home(replace(config, **other), tmp_path) for other in ({}, {"spp": (3, 9), "subpixels": 2}, {"seed": 1})]
    assert places[0] == places[1] != places[2]


def test_what_has_no_references_to_keep_is_refused(tmp_path):
    for why, changes in {
        "pairs .* have no references": {"reference_spp": 0, "inputs": 2},
        "shots": {"frames": 3},
    }.items():
        with pytest.raises(NgptError, match=f"{why}.*leave data.kept out"):
            stream.Stream(DatasetConfig(scenes=1, **changes), None, kept=tmp_path)


def test_an_error_of_a_worker_reaches_the_reader(monkeypatch):
    def fail(*_):
        raise NgptError("disk full")

    monkeypatch.setattr(stream, "make_shard", fail)
    with ThreadPoolExecutor(1) as executor, pytest.raises(NgptError, match="disk full"):
        stream.Stream(DatasetConfig(scenes=1, crops=1), executor).__enter__()
