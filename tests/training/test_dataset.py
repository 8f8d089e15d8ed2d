"""The store of training sets, without a renderer: what is written is read back, and damage is named."""

import hashlib
import json
import os
import pickle

import numpy as np
import pytest
from made_sets import SIZE, crop_data, write_set

from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.training.dataset import Dataset, problems, summary
from ngpt.training.shards import FAR, MAX_LOSS, CropData, Shard, smallest_float, write_shard

pytest.importorskip("safetensors")
from safetensors.numpy import load_file, save_file


@pytest.fixture
def given(rng):
    return [crop_data(rng), crop_data(rng), crop_data(rng, caustic=True, halves=True)]


@pytest.fixture
def folder(tmp_path, given):
    """A training set of two shards, with 2 and 1 crops of two scenes."""
    write_set(tmp_path, {"a": given[:2], "b": given[2:]})
    return tmp_path


def test_what_is_written_is_read_back(folder, given):
    data = pickle.loads(pickle.dumps(Dataset(folder)))
    assert (len(data), data.scenes, data[2].scene, data[-1].scene) == (3, ("a", "b"), "b", "b")
    assert data.shots == () and data[0].frame is None and "shots" not in summary(folder)
    for crop, expected in zip(data, given, strict=True):
        assert (crop.inputs, crop.spp) == (2, (2, 9))
        light = 0 if expected.reference_caustic is None else expected.reference_caustic
        np.testing.assert_allclose(crop.reference, expected.reference, rtol=2e-3)
        np.testing.assert_allclose(crop.reference_direct, expected.reference_direct, atol=1e-3)
        np.testing.assert_allclose(crop.reference_caustic, np.broadcast_to(light, (SIZE, SIZE, 3)), atol=1e-3)
        for stack, wanted in zip((crop.stack(0), crop.stack(1)), expected.stacks, strict=True):
            assert set(stack.names) == set(wanted.names) and "ngpt:frame" not in stack.attributes
            for name in stack.names:
                np.testing.assert_allclose(stack[name], wanted[name], rtol=3e-3, atol=1e-6)
    with pytest.raises(IndexError):
        data[3]
    with pytest.raises(NgptError, match="input 2"):
        data[0].stack(2)


def test_halves_of_references_are_read_back_and_judge(folder, given):
    """Each is without direct emission; beside it stands what the network is to make of it."""
    pytest.importorskip("torch")
    from ngpt.network.model import ModelConfig
    from ngpt.training.examples import judges_of

    data, crop = Dataset(folder), given[2]
    light = [half - crop.reference_direct for half in crop.halves]
    np.testing.assert_allclose(data[2].reference_halves, light, atol=2e-3)
    with_gradients, colour = (ModelConfig("plain", (4,), (), inputs) for inputs in (("primal", "dx"), ("primal",)))
    np.testing.assert_allclose(judges_of(data[2], with_gradients), light, atol=2e-3)
    whole = [half + crop.reference_caustic for half in light]
    np.testing.assert_allclose(judges_of(data[2], colour), whole, atol=4e-3)
    assert data[0].reference_halves == () and len(judges_of(data[0], colour)) == 1


@pytest.mark.parametrize("split", [False, True])
def test_inputs_without_gradients(tmp_path, rng, given, split):
    bare = [
        GradientStack({name: stack[name] for name in stack.names if not name.startswith(("dx", "dy"))})
        for stack in given[0].stacks
    ]
    if split:
        parts = ("diffuse", "specular", "diffuse_var", "specular_var")
        bare = [stack.replace(**{name: rng.random((SIZE, SIZE, 3)) for name in parts}) for stack in bare]
    crop = CropData(bare, [2, 9], given[0].reference, given[0].reference_direct)
    read = write_set(tmp_path, {"a": [crop]})[0].stack(1)
    assert not {"dx", "dy", "dx_se", "dy_se"} & set(Shard(tmp_path / "shards/a.safetensors").names)
    assert sorted(read.names) == sorted(bare[1].names)
    for name in read.names:
        np.testing.assert_allclose(read[name], bare[1][name], rtol=2e-3, atol=1e-4)


def test_bright_lamps_cost_no_digits_and_arrays_lie_in_any_order(tmp_path, given):
    """Where the camera sees a lamp of 10^4, what is learnt there, about 1, keeps its digits."""
    lamp = np.full((3, SIZE, SIZE), 1e4, np.float32).transpose(1, 2, 0)
    turned = np.ascontiguousarray(given[0].reference_direct.transpose(2, 0, 1)).transpose(1, 2, 0)
    bright, other = (CropData(given[0].stacks, [2, 9], light + 1, light) for light in (lamp, turned))
    data = write_set(tmp_path, {"a": [bright], "b": [other]})
    np.testing.assert_allclose(data[0].shard.crop("reference_indirect", 0), 1, rtol=1e-3)
    np.testing.assert_allclose(data[1].reference_direct, turned, rtol=2e-3)


FRAMES = [0, 1, 2, 0, 1, 2, 0, 1]


@pytest.fixture
def motions(rng):
    known = [np.float32(rng.normal(0, 3, (SIZE, SIZE, 2))) if t else np.full((SIZE, SIZE, 2), np.nan) for t in FRAMES]
    known[1][2, 3] = np.nan
    known[2][4, 5] = 1e30, -1e30
    return known


@pytest.fixture
def shots(tmp_path, rng, motions):
    """Two shots of three frames in a shard, and one of two in another."""
    crops = [crop_data(rng, motion=motion) for motion in motions]
    return write_set(tmp_path, {"s0": crops[:6], "s1": crops[6:]}, FRAMES)


def test_frames_are_crops_with_motion_in_their_order(shots, motions):
    assert shots.shots == (range(3), range(3, 6), range(6, 8)) and [crop.frame for crop in shots] == FRAMES
    for crop, motion in zip(shots, motions, strict=True):
        stack = crop.stack(1)
        known = np.abs(np.nan_to_num(motion, nan=FAR)) < FAR
        # To the last bit: halves of motion would miss by hundredths of a pixel.
        assert np.array_equal(stack["motion"][known], motion[known]) and np.isnan(stack["motion"][~known]).all()
        assert (stack.number("ngpt:frame"), stack.number("ngpt:previousFrame")) == (crop.frame, crop.frame - 1)
    assert problems(shots.folder) == [] and summary(shots.folder)["shots"] == 3


def tampered(folder, change):
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest, manifest["shards"][0])
    (folder / "manifest.json").write_text(json.dumps(manifest))


def test_problems_are_named(folder):
    assert problems(folder) == []
    tampered(folder, lambda manifest, entry: entry["crops"].append(entry["crops"][0]))
    assert any("it must be (3, 2, 8, 8, 3)" in line for line in problems(folder))
    (folder / "shards" / "b.safetensors").rename(folder / "shards" / "c.safetensors")
    found = "\n".join(problems(folder))
    assert "b.safetensors: is missing" in found and "c.safetensors: is not in the manifest" in found


def test_of_two_writers_of_a_shard_the_first_stays(tmp_path, given, monkeypatch):
    """The records differ by the times in them, and the manifest may have the first one's checksum."""
    path = tmp_path / "a.safetensors"
    write_shard(path, given[:1], {"seconds": 1})
    first = path.read_bytes()
    write_shard(path, given[:1], {"seconds": 2})
    assert path.read_bytes() == first and os.listdir(tmp_path) == ["a.safetensors"]
    # What an hour made is kept in the working directory then.
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(NgptError, match="does not exist"):
        write_shard(tmp_path / "nowhere" / "a.safetensors", given[:1], {})
    assert Shard(tmp_path / "here" / "a.kept.safetensors").record == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m, e: e.update(file="/etc/passwd"), "lists '/etc/passwd', which is outside its folder"),
        (lambda m, e: e.pop("sha256"), r"manifest\.json: 'shards'\[0\]: lacks 'sha256'"),
        (lambda m, e: e["crops"][0].update(spp="many"), r"'crops'\[0\]: 'spp' is 'many'; it must be a list"),
        (lambda m, e: e.update(bytes=10**400), r"'bytes' is 1000.*; it must be int"),
        (lambda m, e: m.update(shards={}), "'shards' is {}; it must be a list"),
        (lambda m, e: m.update(version=9), "version 9"),
        (lambda m, e: m.pop("format"), "not the manifest"),
        (lambda m, e: e["crops"][0].update(frame=1.5), "'frame' of a crop of .* is .*int"),
        (lambda m, e: e["crops"][0].update(frame=None), "'frame' of a crop of .* is .*int"),
    ],
)
def test_manifests_that_cannot_be_used_are_refused(folder, change, message):
    tampered(folder, change)
    with pytest.raises(NgptError, match=message):
        Dataset(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "no training set"), ("[" * 100_000, "its brackets are nested"), ("{", "cannot be read")],
)
def test_manifests_that_are_none(tmp_path, text, message):
    if text is not None:
        (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(NgptError, match=message):
        Dataset(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [(lambda data: data[:-1] + b"x", "its sha256 is"), (lambda data: None, "is missing")],
)
def test_changed_shards_are_not_trained_on(folder, capsys, change, message):
    shard = folder / "shards" / "a.safetensors"
    assert main(["info", str(folder)]) == 0 and "crops: 3" in capsys.readouterr().out
    data = change(shard.read_bytes())
    shard.unlink()
    if data:
        shard.write_bytes(data)
    with pytest.raises(NgptError, match=rf"a\.safetensors: {message}"):
        Dataset(folder)[0]
    assert Dataset(folder)[2].stack(0)
    assert main(["info", str(folder)]) == 1 and f"a.safetensors: {message}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("dx", lambda t: t["dx"][:, :1], r"tensor 'dx' is \(6, 1, 8, 8, 3\), it must be \(6, 2, 8, 8, 3\)"),
        (
            "indirect",
            lambda t: t["indirect"][0],
            r"tensor 'indirect' is \(2, 8, 8, 3\); it must have 5 axes, with 2 inputs",
        ),
        ("albedo", lambda t: t["albedo"].astype("f8"), "tensor 'albedo' is of type F64"),
        ("motion", lambda t: t["motion"][..., :1], r"tensor 'motion' is \(6, 8, 8, 1\), it must be \(6, 8, 8, 2\)"),
        ("reference_halves", lambda t: t["indirect"][:, :1], r"'reference_halves' is \(6, 1, 8, 8, 3\), it must be"),
    ],
)
def test_shards_with_other_tensors_are_refused(shots, name, change, message):
    """Though their checksum is right."""
    shard = shots.folder / "shards" / "s0.safetensors"
    tensors = load_file(shard)
    tensors[name] = np.ascontiguousarray(change(tensors))
    save_file(tensors, shard, {"ngpt": "{}"})
    digest = hashlib.sha256(shard.read_bytes()).hexdigest()
    tampered(shots.folder, lambda manifest, entry: entry.update(sha256=digest))
    with pytest.raises(NgptError, match=message):
        Dataset(shots.folder)[0]


def test_a_shard_that_is_cut_while_it_is_read_is_named(folder):
    """Were it mapped into memory, the process would end without a word."""
    shard = folder / "shards" / "a.safetensors"
    data = Dataset(folder)
    whole = data[0].stack(1)["primal"]
    content = shard.read_bytes()
    with open(shard, "r+b") as file:
        file.truncate(len(content) // 3)
    with pytest.raises(NgptError, match=r"a\.safetensors: ends amid tensor '\w+', after \d+ bytes: it was cut"):
        for crop in (data[0], data[1]):
            crop.stack(0), crop.stack(1), crop.reference
    shard.write_bytes(content)
    assert np.array_equal(data[0].stack(1)["primal"], whole)
    kept, light = Shard(shard, keep_open=True), data[0].reference_direct
    shard.unlink()
    assert np.array_equal(kept.crop("reference_direct", 0), light)
    with pytest.raises(NgptError, match=r"a\.safetensors: cannot be read any more: No such file"):
        data[0].stack(0)


def test_pairs_without_noise_of_their_own_are_named(tmp_path, given):
    """Both halves rendered by one seed; and a shard without references whose crops are no pairs."""
    good, bad, three = (CropData(crop.stacks, [4, 4]) for crop in given[:2] + given[:1])
    bad.stacks[1] = bad.stacks[0]
    three = CropData([*three.stacks, three.stacks[0]], [2, 3, 4])
    data = write_set(tmp_path, {"a": [good, bad], "b": [three]}, reference_spp=0)
    same, no_pair = problems(tmp_path)
    assert "both halves of crop 1 are the same" in same and "must be pairs: 2 inputs with gradients, not 3" in no_pair
    assert data[0].paired and np.allclose(data[0].stack(1)["dx"], good.stacks[1]["dx"], atol=2e-3)


@pytest.mark.parametrize(("scale", "dtype"), [(1, np.float16), (1e5, np.float32), (1e-7, np.float32)])
def test_half_floats_only_where_safe(rng, scale, dtype):
    """Neither overflow nor underflow, and one bad crop is enough."""
    tensor = np.stack([rng.random((8, 8)), scale * rng.random((8, 8))])
    small = smallest_float(tensor)
    assert small.dtype == dtype
    assert np.all(np.abs(small - tensor).sum(axis=(1, 2)) <= MAX_LOSS * tensor.sum(axis=(1, 2)))


def test_numbers_that_are_not_finite_are_refused(tmp_path, given):
    given[0].reference[0, 0, 0] = np.nan
    with pytest.raises(NgptError, match="reference_indirect"):
        write_shard(tmp_path / "x.safetensors", given[:1], {})
    assert not list(tmp_path.iterdir())
