"""Sets of shots: frames are crops with motion, in their order; sets of single images are what they were."""

import hashlib
import json

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.training.dataset import FORMAT, VERSION, Dataset, problems, summary

pytest.importorskip("safetensors")

from ngpt.training.shards import FAR, CropData, Shard, write_shard

SIZE = 8


def frame_of(rng, motion):
    layers = {name: rng.random((SIZE, SIZE, 3)) for name in ("primal", "albedo", "normal", "primal_var")}
    layers |= {"direct": np.zeros((SIZE, SIZE, 3)), "depth": rng.random((SIZE, SIZE, 1))}
    stack = GradientStack({name: layer.astype(np.float32) for name, layer in layers.items()})
    reference = rng.random((SIZE, SIZE, 3)).astype(np.float32)
    return CropData([stack, stack], [2, 9], reference, np.zeros_like(reference), motion=motion)


def write_set(folder, shards):
    """``shards``: lists of (crop, its frame, or None for a single image)."""
    entries = []
    (folder / "shards").mkdir()
    for number, crops in enumerate(shards):
        told = [{"spp": list(crop.spp), "seconds": {}} for crop, _ in crops]
        for record, (_, frame) in zip(told, crops, strict=True):
            record |= {} if frame is None else {"frame": frame}
        record = {"scene": f"s{number}", "crops": told, "failures": []}
        path = folder / f"shards/s{number}.safetensors"
        write_shard(path, [crop for crop, _ in crops], record)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        entries.append({"file": f"shards/{path.name}", "sha256": digest, "bytes": path.stat().st_size} | record)
    manifest = {"format": FORMAT, "version": VERSION, "config": {}, "planned": 1, "shards": entries}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.fixture
def shots(tmp_path, rng):
    """Two shots of three frames in a shard, and one of two in another; and their motion."""
    frames = [0, 1, 2, 0, 1, 2, 0, 1]
    motions = [np.float32(rng.normal(0, 3, (SIZE, SIZE, 2))) if t else np.full((SIZE, SIZE, 2), np.nan) for t in frames]
    motions[1][2, 3] = np.nan
    motions[2][4, 5] = 1e30, -1e30
    crops = [(frame_of(rng, motion), t) for motion, t in zip(motions, frames, strict=True)]
    return write_set(tmp_path, [crops[:6], crops[6:]]), motions


def test_frames_are_crops_with_motion_in_their_order(shots):
    folder, motions = shots
    data = Dataset(folder)
    assert data.shots == (range(3), range(3, 6), range(6, 8)) and len(data) == 8
    for crop, motion in zip(data, motions, strict=True):
        stack = crop.stack(1)
        known = np.abs(np.nan_to_num(motion, nan=FAR)) < FAR
        # To the last bit: halves of motion would miss by hundredths of a pixel.
        assert np.array_equal(stack["motion"][known], motion[known]) and np.isnan(stack["motion"][~known]).all()
    assert [crop.frame for crop in data] == [0, 1, 2, 0, 1, 2, 0, 1]
    attributes = data[4].stack(0).attributes
    assert (attributes["ngpt:frame"], attributes["ngpt:previousFrame"]) == (1, 0)
    assert problems(folder) == [] and summary(folder)["shots"] == 3


def test_a_history_follows_frames_and_ends_with_the_shot(shots):
    from ngpt.sequence.history import Temporal

    temporal, shares = Temporal(), []
    for crop in Dataset(shots[0]):
        stack = crop.stack(0)
        temporal.next(stack, stack["primal"])
        shares.append(temporal.share)
    assert [share > 0 for share in shares] == [False, True, True, False, True, True, False, True]


def test_single_images_have_neither_motion_nor_shots(tmp_path, rng):
    folder = write_set(tmp_path, [[(frame_of(rng, None), None)] * 2])
    data = Dataset(folder)
    assert data.shots == () and data[0].frame is None and "shots" not in summary(folder)
    assert "motion" not in data[0].stack(0) and "ngpt:frame" not in data[0].stack(0).attributes
    assert "motion" not in Shard(folder / "shards/s0.safetensors").names


@pytest.mark.parametrize("frame", ["first", 1.5, True, None, 10**400])
def test_frames_that_are_no_numbers_are_refused(shots, frame):
    folder, _ = shots
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][0]["crops"][0]["frame"] = frame
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(NgptError, match=r"manifest\.json: 'frame' of a crop of 'shards/s0.safetensors' is .*int"):
        Dataset(folder)


def test_motion_of_another_shape_is_refused(shots):
    from safetensors.numpy import load_file, save_file

    folder, _ = shots
    path = folder / "shards/s1.safetensors"
    tensors = load_file(path)
    save_file(tensors | {"motion": tensors["motion"][..., :1].copy()}, path, {"ngpt": "{}"})
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][1]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(NgptError, match=r"tensor 'motion' is \(2, 8, 8, 1\), it must be \(2, 8, 8, 2\)"):
        Dataset(folder)[6]
