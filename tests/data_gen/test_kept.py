"""References kept small, their inputs rendered anew; pairs, which have none; plans that never end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.training.dataset import Crop, Dataset, problems

pytest.importorskip("safetensors")
pytest.importorskip("mitsuba")

from data_gen.dataset import crops, jobs
from data_gen.dataset.card import write_card
from data_gen.dataset.config import Config
from data_gen.dataset.kept import Again, Kept, keep, packed, unpacked
from ngpt.training.shards import Shard

SMALL = Config(size=16, inputs=2, spp=(2, 4), scenes=1, crops=2, reference_spp=8)


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


def test_references_share_no_tails(renderer, tmp_path):
    """Those of inputs that do are the same to the bit."""
    read = []
    for name, tails in (("paths", {}), ("shared", {"gpt": {"tails": "shared"}})):
        config = replace(SMALL, crops=1, samplers=tails)
        (job,) = config.plan()
        (tmp_path / name / "shards").mkdir(parents=True)
        shard = Shard(tmp_path / name / crops.make_shard(config, job, str(tmp_path / name), "llvm_ad_rgb"))
        read.append(Crop(shard, 0, "made", tuple(shard.record["crops"][0]["spp"])))
    paths, shared = read
    assert np.array_equal(paths.reference, shared.reference)
    assert not np.array_equal(paths.stack(1)["primal"], shared.stack(1)["primal"])


def test_inputs_are_rendered_anew(renderer, tmp_path):
    """The reference and the view stay; the noise is another."""
    (job,) = SMALL.plan()
    read = []
    for name, again in (("first", None), ("second", 1), ("third", 2)):
        (tmp_path / name / "shards").mkdir(parents=True)
        given = None if again is None else Again(str(tmp_path / "kept.safetensors"), again)
        shard = Shard(tmp_path / name / crops.make_shard(SMALL, job, str(tmp_path / name), "llvm_ad_rgb", given))
        if again is None:
            keep(shard, tmp_path / "kept.safetensors")
        read.append([Crop(shard, i, "made", tuple(told["spp"])) for i, told in enumerate(shard.record["crops"])])
    assert len(Kept(tmp_path / "kept.safetensors").places) == len(read[0]) == 2
    for first, second, third in zip(*read, strict=True):
        for crop in (second, third):
            # Light of the layer ``caustic`` may be negative here and there, and sums of both err by more than each.
            for name in ("reference_direct", "reference_caustic"):
                np.testing.assert_allclose(getattr(crop, name), getattr(first, name), rtol=0.01, atol=1e-4)
            np.testing.assert_allclose(crop.reference, first.reference, rtol=0.01, atol=1e-3)
            # What has next to no noise shows that the camera is the same.
            depths = [np.median(c.stack(1)["depth"]) for c in (first, crop)]
            assert depths[0] == pytest.approx(depths[1], rel=0.05)
        inputs = [crop.stack(1)["primal"] for crop in (first, second, third)]
        assert not any(np.array_equal(inputs[i], inputs[i - 1]) for i in range(3))


def test_pairs(renderer, tmp_path):
    config = replace(SMALL, reference_spp=0)
    jobs.generate(config, tmp_path, jobs.Serial())
    write_card(tmp_path)
    assert problems(tmp_path) == [] and "No references" in (tmp_path / "README.md").read_text()
    for crop in Dataset(tmp_path):
        assert crop.paired and crop.spp[0] == crop.spp[1]
        a, b = (crop.stack(k) for k in range(2))
        assert not np.array_equal(a["primal"], b["primal"]) and np.all(a["dx_var"] >= 0)
        with pytest.raises(NgptError, match="is a pair: it has no reference"):
            _ = crop.reference


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": 3}, "set inputs = 2"),
        ({"frames": 2}, "learnt from references"),
        ({"adaptive": 0.5, "spp": (2, 64)}, "halves are alike"),
        ({"sampler": "primal"}, "renders no gradients"),
        ({"reference_spp": 2}, "at least 4, two for each of its halves; or 0, for pairs"),
    ],
)
def test_pairs_that_are_none(changes, message):
    with pytest.raises(NgptError, match=message):
        replace(SMALL, **{"reference_spp": 0} | changes)


def test_plans_go_on_for_ever(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "scene.xml").touch()
    from data_gen.dataset.config import Files

    config = replace(SMALL, scenes=2, crops=3, crops_per_shard=2, files=(Files(str(tmp_path / "*/scene.xml"), 3),))
    plans = [config.plan(turn) for turn in range(3)]
    everything = [(job.scene, crop) for plan in plans for job in plan for crop in job.crops]
    assert len(set(everything)) == len(everything) == 27
    assert len({job.file for plan in plans for job in plan}) == 18
    assert ("made-00004", 0) in everything and ("a-scene", 8) in everything
    assert Path(plans[0][0].file).name == "made-00000-000.safetensors"
