"""The store of training sets, without a renderer: what is written is read back, and damage is named."""

import hashlib
import json
import os
import pickle

import numpy as np
import pytest

from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.training.dataset import FORMAT, VERSION, Crop, Dataset, problems
from ngpt.training.shards import MAX_LOSS, CropData, Shard, smallest_float, write_shard

pytest.importorskip("safetensors")


def crop_data(rng, scale=1.0, inputs=2, size=8, caustic=False, halves=False):
    def layers():
        made = {name: scale * rng.random((size, size, 3)) for name in ("direct", "dx", "dy")}
        made["primal"] = made["direct"] + scale * rng.random((size, size, 3))
        made |= {name: rng.random((size, size, 3)) for name in ("albedo", "normal")} | {
            "depth": rng.random((size, size))
        }
        varying = ["primal", "dx", "dy"]
        if caustic:
            varying.append("caustic")
            made["caustic"] = scale * rng.random((size, size, 3))
            made["primal"] = made["primal"] + made["caustic"]
        return made | {f"{name}_var": scale**2 * rng.random((size, size, 3)) for name in varying}

    stacks = [GradientStack(layers()) for _ in range(inputs)]
    direct = np.float32(scale * rng.random((size, size, 3)))
    light = np.float32(scale * rng.random((size, size, 3))) if caustic else None
    reference = direct + np.float32(scale) + (light if caustic else 0)
    apart = tuple(direct + np.float32(scale * rng.random((size, size, 3))) for _ in range(2 * halves))
    return CropData(stacks, [2, 9][:inputs], reference, direct, light, apart)


@pytest.fixture
def folder(tmp_path, rng):
    """A training set of two shards, with 2 and 1 crops of two scenes; and what is in it."""
    given, entries = [], []
    for scene, count in (("a", 2), ("b", 1)):
        crops = [crop_data(rng, caustic=scene == "b") for _ in range(count)]
        path = tmp_path / "shards" / f"{scene}-000.safetensors"
        path.parent.mkdir(exist_ok=True)
        told = [{"spp": list(crop.spp), "seconds": {"inputs": 1.0}} for crop in crops]
        record = {"scene": scene, "crops": told, "failures": []}
        write_shard(path, crops, record)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        name = f"shards/{path.name}"
        entries.append({"file": name, "sha256": digest, "bytes": path.stat().st_size} | record)
        given += crops
    manifest = {"format": FORMAT, "version": VERSION, "config": {}, "planned": 3, "shards": entries}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    return tmp_path, given


def test_halves_of_references_are_read_back_and_judge(tmp_path, rng):
    """Each is without direct emission; beside it stands what the network is to make of it."""
    crop = crop_data(rng, caustic=True, halves=True)
    write_shard(tmp_path / "x.safetensors", [crop, crop], {"scene": "a"})
    read = Crop(Shard(tmp_path / "x.safetensors"), 1, "a", (2, 9))
    light = [half - crop.reference_direct for half in crop.halves]
    np.testing.assert_allclose(read.reference_halves, light, atol=2e-3)
    pytest.importorskip("torch")
    from ngpt.network.model import ModelConfig
    from ngpt.training.examples import judges_of

    body = {"network": "plain", "channels": (4,), "units": ()}
    with_gradients = ModelConfig(inputs=("primal", "dx", "dy"), **body)
    np.testing.assert_allclose(judges_of(read, with_gradients), light, atol=2e-3)
    colour = ModelConfig(inputs=("primal",), **body)
    np.testing.assert_allclose(judges_of(read, colour), [half + crop.reference_caustic for half in light], atol=4e-3)
    bare = crop_data(rng)
    write_shard(tmp_path / "y.safetensors", [bare], {"scene": "a"})
    read = Crop(Shard(tmp_path / "y.safetensors"), 0, "a", (2, 9))
    assert read.reference_halves == () and len(judges_of(read, colour)) == 1


@pytest.mark.parametrize("split", [False, True])
def test_inputs_without_gradients(tmp_path, rng, split):
    crop = crop_data(rng)
    bare = [
        GradientStack({name: stack[name] for name in stack.names if not name.startswith(("dx", "dy"))})
        for stack in crop.stacks
    ]
    if split:
        parts = ("diffuse", "specular", "diffuse_var", "specular_var")
        bare = [stack.replace(**{name: rng.random((8, 8, 3)) for name in parts}) for stack in bare]
    path = tmp_path / "a.safetensors"
    write_shard(path, [CropData(bare, crop.spp, crop.reference, crop.reference_direct)], {"scene": "a"})
    assert not {"dx", "dy", "dx_se", "dy_se"} & set(Shard(path).names)
    told = [{"spp": list(crop.spp), "seconds": {"inputs": 1.0}}]
    entry = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "scene": "a", "crops": told}
    entry |= {"bytes": path.stat().st_size, "failures": []}
    manifest = {"format": FORMAT, "version": VERSION, "config": {}, "planned": 1, "shards": [entry]}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    read = Dataset(tmp_path)[0].stack(1)
    assert sorted(read.names) == sorted(bare[1].names)
    for name in read.names:
        np.testing.assert_allclose(read[name], bare[1][name], rtol=2e-3, atol=1e-4)


def test_what_is_written_is_read_back(folder):
    path, given = folder
    data = pickle.loads(pickle.dumps(Dataset(path)))
    assert (len(data), data.scenes, data[2].scene, data[-1].scene) == (3, ("a", "b"), "b", "b")
    for crop, expected in zip(data, given, strict=True):
        assert (crop.inputs, crop.spp) == (2, (2, 9))
        np.testing.assert_allclose(crop.reference, expected.reference, rtol=2e-3)
        np.testing.assert_allclose(crop.reference_direct, expected.reference_direct, atol=1e-3)
        light = 0 if expected.reference_caustic is None else expected.reference_caustic
        np.testing.assert_allclose(crop.reference_caustic, light, atol=1e-3)
        for k in range(2):
            stack = crop.stack(k)
            assert set(stack.names) == set(expected.stacks[k].names)
            for name in stack.names:
                np.testing.assert_allclose(stack[name], expected.stacks[k][name], rtol=3e-3, atol=1e-6)
    with pytest.raises(IndexError):
        data[3]
    with pytest.raises(NgptError, match="input 2"):
        data[0].stack(2)


def test_bright_lamps_do_not_cost_digits(tmp_path, rng):
    """Where the camera sees a lamp of 10^4, what is learnt there, about 1, keeps its digits."""
    crop = crop_data(rng)
    lamp = np.full((8, 8, 3), 1e4, np.float32)
    bright = CropData(crop.stacks, crop.spp, lamp + 1, lamp)
    write_shard(tmp_path / "x.safetensors", [bright], {})
    np.testing.assert_allclose(Shard(tmp_path / "x.safetensors").crop("reference_indirect", 0), 1, rtol=1e-3)


def test_info_verifies(folder, capsys):
    path, _ = folder
    assert main(["info", str(path)]) == 0
    assert "crops: 3" in capsys.readouterr().out
    shard = path / "shards" / "a-000.safetensors"
    data = bytearray(shard.read_bytes())
    data[-5] ^= 1
    shard.write_bytes(data)
    assert main(["info", str(path)]) == 1
    assert "a-000.safetensors: its sha256" in capsys.readouterr().out


def test_problems_are_named(folder, rng):
    path, _ = folder
    assert problems(path) == []
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["shards"][0]["crops"].append(manifest["shards"][0]["crops"][0])
    (path / "manifest.json").write_text(json.dumps(manifest))
    assert any("it must be (3, 2, 8, 8, 3)" in line for line in problems(path))
    (path / "shards" / "b-000.safetensors").rename(path / "shards" / "c-000.safetensors")
    found = "\n".join(problems(path))
    assert "b-000.safetensors: is missing" in found
    assert "c-000.safetensors: is not in the manifest" in found


def test_of_two_writers_of_a_shard_the_first_stays(tmp_path, rng, monkeypatch):
    """The records differ by the times in them, and the manifest may have the first one's checksum."""
    path, crop = tmp_path / "a.safetensors", crop_data(rng)
    write_shard(path, [crop], {"seconds": 1})
    first = path.read_bytes()
    write_shard(path, [crop], {"seconds": 2})
    assert path.read_bytes() == first and os.listdir(tmp_path) == ["a.safetensors"]
    # What an hour made is kept in the working directory then.
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(NgptError, match="does not exist"):
        write_shard(tmp_path / "nowhere" / "a.safetensors", [crop], {})
    assert Shard(tmp_path / "here" / "a.kept.safetensors").record == {}


def tampered(folder, change):
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest, manifest["shards"][0])
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m, e: e.update(file="/etc/passwd"), "lists '/etc/passwd', which is not in its folder"),
        (lambda m, e: e.update(file="shards/../../x"), "which is not in its folder"),
        (lambda m, e: e.pop("sha256"), r"manifest\.json: 'shards'\[0\]: lacks 'sha256'"),
        (lambda m, e: e["crops"][0].update(spp="many"), r"'crops'\[0\]: 'spp' is 'many'; it must be a list"),
        (lambda m, e: e.update(bytes=10**400), r"'bytes' is 1000.*; it must be int"),
        (lambda m, e: e.update(bytes=True), "'bytes' is True; it must be int"),
        (lambda m, e: m.update(shards={}), "'shards' is {}; it must be a list"),
    ],
)
def test_manifests_that_cannot_be_used_are_refused(folder, change, message):
    tampered(folder[0], change)
    with pytest.raises(NgptError, match=message):
        Dataset(folder[0])


def resealed(path, file):
    """The manifest's checksum brought up to date with a shard that was changed."""
    digest = hashlib.sha256((path / file).read_bytes()).hexdigest()
    tampered(path, lambda m, e: e.update(sha256=digest))


def test_changed_shards_are_not_trained_on(folder):
    path, _ = folder
    shard = path / "shards" / "a-000.safetensors"
    whole = shard.read_bytes()
    for data, message in ((whole[:-1] + b"x", "its sha256 is"), (whole[:500], "its sha256 is"), (None, "is missing")):
        shard.unlink()
        if data:
            shard.write_bytes(data)
        with pytest.raises(NgptError, match=rf"a-000\.safetensors: {message}"):
            Dataset(path)[0]
        assert Dataset(path)[2].stack(0) and any(message in line for line in problems(path))
        shard.touch()


def test_shards_with_other_tensors_are_refused(folder):
    """Though their checksum is right."""
    from safetensors.numpy import load_file, save_file

    path, _ = folder
    shard, record = path / "shards" / "a-000.safetensors", {"ngpt": "{}"}
    tensors = load_file(shard)
    for change, message in [
        ({"dx": tensors["dx"][:, :1]}, r"tensor 'dx' is \(2, 1, 8, 8, 3\), it must be \(2, 2, 8, 8, 3\)"),
        ({"indirect": tensors["indirect"][0]}, r"tensor 'indirect' is \(2, 8, 8, 3\), and its crops have 2 inputs"),
        ({"albedo": tensors["albedo"].astype("f8")}, "tensor 'albedo' is of type F64"),
        ({"reference_halves": tensors["indirect"][:, :1]}, r"'reference_halves' is \(2, 1, 8, 8, 3\), it must be"),
    ]:
        save_file(tensors | change, shard, record)
        resealed(path, "shards/a-000.safetensors")
        with pytest.raises(NgptError, match=message):
            Dataset(path)[0]
    save_file({name: tensor for name, tensor in tensors.items() if name != "depth"}, shard, record)
    resealed(path, "shards/a-000.safetensors")
    with pytest.raises(NgptError, match="tensors depth are missing"):
        Dataset(path)[0]
    save_file(tensors, shard, {"ngpt": "[" * 100_000})
    with pytest.raises(NgptError, match="its record: cannot be read: brackets within brackets"):
        Shard(shard)


def test_a_shard_that_is_cut_while_it_is_read_is_named(folder):
    """Were it mapped into memory, the process would end without a word."""
    path, _ = folder
    shard = path / "shards" / "a-000.safetensors"
    data = Dataset(path)
    whole = data[0].stack(1)["primal"]
    content = shard.read_bytes()
    with open(shard, "r+b") as file:
        file.truncate(len(content) // 3)
    with pytest.raises(NgptError, match=r"a-000\.safetensors: ends amid tensor '\w+', after \d+ bytes: it was cut"):
        for crop in (data[0], data[1]):
            crop.stack(0), crop.stack(1), crop.reference
    shard.write_bytes(content)
    assert np.array_equal(data[0].stack(1)["primal"], whole)
    kept, light = Shard(shard, keep_open=True), data[0].reference_direct
    shard.unlink()
    assert np.array_equal(kept.crop("reference_direct", 0), light)
    with pytest.raises(NgptError, match=r"a-000\.safetensors: cannot be read any more: No such file"):
        data[0].stack(0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no training set"),
        ("[" * 100_000, "brackets within brackets"),
        ("{", "cannot be read"),
        ("{}", "not the manifest"),
        ('{"format": "ngpt-dataset", "version": 9}', "version 9"),
    ],
)
def test_bad_manifests(tmp_path, text, message):
    if text is not None:
        (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(NgptError, match=message):
        Dataset(tmp_path)


def test_pairs_without_noise_of_their_own_are_named(tmp_path, rng):
    """Both halves rendered by one seed; and a shard without references whose crops are no pairs."""
    good, bad = (CropData(crop_data(rng).stacks, [4, 4]) for _ in range(2))
    bad.stacks[1] = bad.stacks[0]
    three = crop_data(rng)
    entries = []
    (tmp_path / "shards").mkdir()
    for name, given in (("a", [good, bad]), ("b", [CropData([*three.stacks, three.stacks[0]], [2, 3, 4])])):
        path = tmp_path / "shards" / f"{name}.safetensors"
        record = {"scene": name, "crops": [{"spp": list(c.spp), "seconds": {}} for c in given], "failures": []}
        write_shard(path, given, record)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        entries.append({"file": f"shards/{path.name}", "sha256": digest, "bytes": path.stat().st_size} | record)
    told = {"format": FORMAT, "version": VERSION, "config": {"reference_spp": 0}, "planned": 3, "shards": entries}
    (tmp_path / "manifest.json").write_text(json.dumps(told))
    same, no_pair = problems(tmp_path)
    assert "both halves of crop 1 are the same" in same and "must be pairs: 2 inputs with gradients, not 3" in no_pair
    assert Dataset(tmp_path)[0].paired and np.allclose(
        Dataset(tmp_path)[0].stack(1)["dx"], good.stacks[1]["dx"], atol=2e-3
    )


@pytest.mark.parametrize(("scale", "dtype"), [(1, np.float16), (1e5, np.float32), (1e-7, np.float32)])
def test_half_floats_only_where_safe(rng, scale, dtype):
    """Neither overflow nor underflow, and one bad crop is enough."""
    tensor = np.stack([rng.random((8, 8)), scale * rng.random((8, 8))])
    small = smallest_float(tensor)
    assert small.dtype == dtype
    assert np.all(np.abs(small - tensor).sum(axis=(1, 2)) <= MAX_LOSS * tensor.sum(axis=(1, 2)))


def test_numbers_that_are_not_finite_are_refused(tmp_path, rng):
    crop = crop_data(rng)
    crop.reference[0, 0, 0] = np.nan
    with pytest.raises(NgptError, match="reference_indirect"):
        write_shard(tmp_path / "x.safetensors", [crop], {})
    assert not list(tmp_path.iterdir())


def test_arrays_in_any_order_of_memory(tmp_path, rng):
    crop = crop_data(rng)
    turned = np.ascontiguousarray(crop.reference_direct.transpose(2, 0, 1)).transpose(1, 2, 0)
    told = CropData(crop.stacks, crop.spp, crop.reference, turned)
    write_shard(tmp_path / "a.safetensors", [told], {"scene": "a"})
    read = Crop(Shard(tmp_path / "a.safetensors"), 0, "a", (2, 9))
    np.testing.assert_allclose(read.reference_direct, crop.reference_direct, rtol=2e-3)
