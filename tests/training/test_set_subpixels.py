"""Training sets with subpixels: pixels are their means, checks find others, and networks read OIDN's image of them."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from made_sets import SIZE, crop_data, write_set

import ngpt
from ngpt.cli import main
from ngpt.denoisers import oidn
from ngpt.errors import NgptError
from ngpt.network.inputs import Oidn
from ngpt.network.model import ModelConfig
from ngpt.repair import repair
from ngpt.subpixels import FINE, means
from ngpt.training.augment import Augmentation
from ngpt.training.dataset import Dataset, problems, summary
from ngpt.training.examples import Examples

pytest.importorskip("safetensors")
from safetensors.numpy import load_file, save_file

K = 2


@pytest.fixture
def given(rng):
    return crop_data(rng, caustic=True, k=K)


def bare(crop):
    """The same crop without subpixels."""
    return replace(crop, stacks=[replace(stack, fine={}) for stack in crop.stacks])


def test_subpixels_are_read_back_and_pixels_are_their_means(given, tmp_path):
    data = write_set(tmp_path, {"a": [given]}, subpixels=K)
    for i, wanted in enumerate(given.stacks):
        stack = data[0].stack(i)
        assert set(stack.fine) == set(FINE) and stack.attributes["ngpt:subpixels"] == K
        assert stack.attributes["ngpt:featureNoise"] == pytest.approx(1e-9)
        for name in FINE:
            assert np.array_equal(stack.fine[name], wanted.fine[name])
            assert np.array_equal(stack[name], wanted[name]) and np.array_equal(means(stack.fine[name], K), stack[name])
        # Files keep them: a reader leaves out subpixels whose means are not the pixels.
        assert ngpt.read(ngpt.write(tmp_path / f"{i}.exr", stack)).fine.keys() == set(FINE)
    assert problems(tmp_path) == [] and summary(tmp_path)["subpixels"] == K


def test_light_beside_a_lamp_keeps_its_digits(given, tmp_path):
    """Some subpixels of its pixels see a lamp of 10^4; the rest of the light there is about 1."""
    lamp = np.zeros((K * SIZE, K * SIZE, 3), np.float32)
    lamp[3:8, 5:12] = 1e4
    stacks = []
    for stack in given.stacks:
        fine = stack.fine | {"primal": stack.fine["primal"] + lamp}
        layers = {"primal": means(fine["primal"], K), "direct": stack["direct"] + means(lamp, K)}
        stacks.append(replace(stack.replace(**layers), fine=fine))
    stacks[1].attributes.clear()
    read = write_set(tmp_path, {"a": [replace(given, stacks=stacks)]})[0]
    assert "ngpt:featureNoise" not in read.stack(1).attributes, "unknown noise of features stays unknown"
    for i, stack in enumerate(stacks):
        assert np.array_equal(repair(read.stack(i)).image, repair(stack).image)
    assert problems(tmp_path) == []


def changed(folder, change):
    """The set with other tensors in its shard, whose checksum is right."""
    shard = folder / "shards/a.safetensors"
    tensors = load_file(shard)
    change(tensors)
    save_file({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, shard, {"ngpt": "{}"})
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["shards"][0]["sha256"] = hashlib.sha256(shard.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("fine_primal"), "tensors fine_primal are missing"),
        (lambda t: t.pop("feature_noise"), "tensors feature_noise are missing"),
        (lambda t: t.update(fine_primal=t["fine_primal"][:, 0]), r"'fine_primal' is \(1, 16, 16, 3\), it must be"),
        (lambda t: t.update(fine_normal=t["normal"]), r"'fine_normal' is \(1, 2, 8, 8, 3\), it must be \(1, 2, 16, 16"),
    ],
)
def test_shards_with_other_subpixels_are_refused(given, tmp_path, change, message):
    write_set(tmp_path, {"a": [given]})
    changed(tmp_path, change)
    with pytest.raises(NgptError, match=message):
        Dataset(tmp_path)[0]


@pytest.mark.parametrize("name", FINE)
def test_subpixels_of_another_image_are_a_problem(given, tmp_path, capsys, name):
    write_set(tmp_path, {"a": [given]})
    changed(tmp_path, lambda t: t.update({f"fine_{name}": t[f"fine_{name}"][:, :, :, ::-1]}))
    found = problems(tmp_path)
    assert (
        len(found) == 2
        and "the subpixels of crop 0, input 1 do not match its pixels; make this shard again" in found[1]
    )
    assert main(["info", str(tmp_path)]) == 1 and "do not match its pixels" in capsys.readouterr().out


def layers_of_examples(folder, crop, *inputs):
    data = write_set(folder, {"a": [crop]})
    drawn = Examples(data, ModelConfig("plain", (4,), (), inputs), Augmentation(False, False, 0), SIZE, 0)
    return drawn._layers(0, data[0], 1)[0]


def test_networks_that_do_not_read_them_are_trained_as_before(given, tmp_path):
    inputs = ("primal", "dx", "dy", "albedo", "normal", "depth", "primal_se")
    with_them, without = (layers_of_examples(tmp_path / str(i), c, *inputs) for i, c in enumerate((given, bare(given))))
    assert with_them.keys() == without.keys()
    for name, layer in with_them.items():
        # Half floats hold the others.
        np.testing.assert_allclose(layer, without[name], rtol=2e-3, atol=2e-3)


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_networks_that_read_oidn_read_its_image_of_subpixels(given, tmp_path):
    given = replace(given, stacks=[replace(stack, attributes={"ngpt:featureNoise": 0.0}) for stack in given.stacks])
    found = layers_of_examples(tmp_path, given, "primal", "denoised")["denoised"].numpy().transpose(1, 2, 0)
    data = repair(given.stacks[1], False)
    of_subpixels, of_pixels = Oidn(data).of_primal, Oidn(replace(data, fine={})).of_primal
    np.testing.assert_allclose(found, of_subpixels, atol=1e-5)
    assert np.abs(found - of_pixels).max() > 0.01
