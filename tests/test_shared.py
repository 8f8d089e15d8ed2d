"""Noise that pixels share: merged, added for estimates of the error, told, carried along in files."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from shots import part_of

import ngpt
from ngpt.api.uncertainty import noisier
from ngpt.io.aliases import OWN
from ngpt.io.resolution import resolve
from ngpt.merging import merge
from ngpt.shared import noise_of_light, shared_variance
from ngpt.stack import GradientStack

OWN_VARIANCE, SHARED_VARIANCE = 0.09, 0.04  # of one sample per pixel
SIDE = 8  # of the squares of pixels that share one value


def smooth(rng, shape):
    """Noise of variance 1 that is the same in squares of pixels, (..., H, W, 3)."""
    *n, height, width = shape
    cells = rng.standard_normal((*n, height // SIDE, width // SIDE, 1))
    return np.repeat(np.repeat(np.repeat(cells, SIDE, -3), SIDE, -2), 3, -1)


def stack_of(rng, spp, seed, shared=True, shape=(32, 32), options=None):
    """Light of 1 with noise of its own and, if ``shared``, noise that squares of pixels share; both as claimed."""
    own = rng.standard_normal((*shape, 3)) * np.sqrt(OWN_VARIANCE / spp)
    layers = {"primal": 1 + own, "primal_var": np.full((*shape, 3), OWN_VARIANCE / spp)}
    if shared:
        # Two draws of one distribution: the noise of the primal, and the sample of it.
        noise, sample = (np.sqrt(SHARED_VARIANCE / spp) * smooth(rng, shape) for _ in range(2))
        layers |= {"primal": layers["primal"] + noise, "shared": sample}
        layers["primal_var"] += shared_variance(sample.astype(np.float32))
    known = {"ngpt:spp": spp, "ngpt:seed": str(seed), "ngpt:sampler": "primal"}
    if shared:
        known["ngpt:samplerOptions"] = "tails=shared"
    return GradientStack.from_arrays(path=f"{seed}.exr", attributes=known | (options or {}), **layers)


@pytest.mark.parametrize("parts", [[(16, True), (16, True)], [(8, True), (32, True)], [(16, False), (16, True)]])
def test_claims_of_merged_stacks_are_right(rng, parts):
    """Of pixels and of blocks, against the variance of the merged images themselves."""
    images, claims, shared, own = [], [], [], []
    for run in range(40):
        merged = merge([stack_of(rng, spp, 2 * run + i, is_shared) for i, (spp, is_shared) in enumerate(parts)])
        images.append(merged["primal"] - 1.0)
        claims.append(merged["primal_var"])
        shared.append(merged["shared"])
        own.append(merged["primal_var"] - shared_variance(merged["shared"]))
    images, shared = np.array(images, np.float64), np.array(shared, np.float64)
    total = sum(spp for spp, _ in parts)
    part = sum(spp for spp, is_shared in parts if is_shared) / total**2 * SHARED_VARIANCE
    assert np.mean(own) == pytest.approx(OWN_VARIANCE / total, rel=0.03) and np.min(own) >= -1e-7
    assert np.mean(claims) == pytest.approx(np.mean(images**2), rel=0.08)
    assert np.mean(claims) == pytest.approx(OWN_VARIANCE / total + part, rel=0.08)
    blocks = [each.reshape(40, 4, 8, 4, 8, 3).mean(axis=(2, 4)) for each in (images, shared)]
    claimed = OWN_VARIANCE / total / 64 + np.mean(blocks[1] ** 2)
    assert np.mean(blocks[0] ** 2) == pytest.approx(claimed, rel=0.12)


def test_tiles_keep_what_their_pixels_share(rng):
    whole = stack_of(rng, 4, 0)
    left, right = part_of(whole, 0, 0, 16, 32), part_of(whole, 16, 0, 16, 32)
    merged = merge([left, right])
    for name in ("primal", "shared"):
        assert np.array_equal(merged[name], whole[name])
    # At the seam the squares are averaged over the pixels of both.
    assert np.allclose(
        np.delete(merged["primal_var"], np.s_[14:18], 1), np.delete(whole["primal_var"], np.s_[14:18], 1)
    )
    own = merged["primal_var"] - shared_variance(merged["shared"])
    assert np.allclose(np.delete(own, np.s_[14:18], 1), OWN_VARIANCE / 4, rtol=1e-4)


def test_what_a_blur_leaves_of_shared_noise_is_in_the_error(rng):
    """White noise of the same variance would be lost in it."""

    def blurred(image):
        return gaussian_filter(image.astype(np.float64), (4, 4, 0))

    stack = stack_of(rng, 1, 0, shape=(256, 256))
    white = GradientStack({name: stack[name] for name in stack.names if name != "shared"})
    true = np.sqrt(np.mean(np.square(blurred(stack["primal"]) - 1)))
    found, lost = (np.sqrt(np.mean(np.square(blurred(noisier(s)["primal"] - s["primal"])))) for s in (stack, white))
    assert found == pytest.approx(true, rel=0.1) and lost < 0.3 * true
    # In the pixels themselves both have the same.
    found, lost = (np.std(noisier(s)["primal"] - s["primal"]) for s in (stack, white))
    assert found == pytest.approx(lost, rel=0.03)
    assert np.array_equal(noisier(stack)["primal"], noisier(stack)["primal"])
    error = ngpt.reconstruct_with_error(stack, "primal").error
    assert np.mean(error) == pytest.approx(0.9 * np.sqrt(OWN_VARIANCE + SHARED_VARIANCE), rel=0.1)


def test_noise_of_light(rng):
    """Both parts as they were drawn, of the whole image and of blocks."""
    found = [
        noise_of_light(s["primal"], s["primal_var"], s["shared"]) for s in (stack_of(rng, 1, i) for i in range(80))
    ]
    whole, blocks = (
        [np.sqrt(np.mean([n[of][part] ** 2 for n in found])) for part in ("own", "shared")] for of in found[0]
    )
    small = noise_of_light(*(np.full((9, 40, 3), value, np.float32) for value in (2.0, 0.0, 0.5)))
    assert list(found[0]) == ["whole image", "blocks of 32x32"] and list(small) == ["whole image"]
    expected = [np.sqrt(OWN_VARIANCE / 32**2), np.sqrt(SHARED_VARIANCE / (32 / SIDE) ** 2)]
    assert whole == pytest.approx(expected, rel=0.2) and blocks == pytest.approx(expected, rel=0.2)
    assert small["whole image"] == {"own": 0, "shared": 0.25}


def test_info_tells_both_parts_and_what_became_of_the_cache(rng, tmp_path, command):
    ngpt.write(tmp_path / "a.exr", stack_of(rng, 4, 1, options={"ngpt:tails": "on", "ngpt:tailsCut": 0.25}))
    held = ngpt.read(tmp_path / "a.exr")
    noise = noise_of_light(held["primal"], held["primal_var"], held["shared"])
    assert "shared tails: on; 25 % of the cache's light was cut from records that were too" in command("info a.exr").out
    told = json.loads(command("info a.exr --json").out)["noise of the mean light, relative to it"]
    assert all(told[of] == pytest.approx(noise[of]) for of in noise) and told.keys() == noise.keys()
    ngpt.write(tmp_path / "b.exr", stack_of(rng, 4, 1, shared=False))
    assert not {name for name in json.loads(command("info b.exr --json").out) if "noise" in name or "tails" in name}


def test_results_keep_the_layer_of_the_input(rng, tmp_path, command):
    stack = stack_of(rng, 4, 1)
    ngpt.write(tmp_path / "a.exr", stack)
    held = ngpt.read("a.exr")["shared"]
    assert np.allclose(held, stack["shared"], rtol=1e-3)
    command("denoise a.exr -o out.exr -m primal --error")
    assert np.array_equal(ngpt.read("out.exr")["shared"], held)
    assert "relMSE" in command("diff a.exr out.exr").out


def test_training_leaves_the_layer_out(rng, tmp_path):
    """Inputs with and without it are alike, in folders of stacks and in shards."""
    pytest.importorskip("torch")
    from full_stack import full_stack

    from ngpt.training.crops import stack_folder
    from ngpt.training.shards import CropData

    bare = full_stack(16, 16).replace(direct=np.zeros((16, 16, 3)))
    stacks = [bare.replace(shared=0.1 * smooth(rng, (16, 16))), bare]
    (tmp_path / "view").mkdir()
    for name, stack in zip(("1", "2", "reference"), (*stacks, bare), strict=True):
        ngpt.write(tmp_path / "view" / f"{name}.exr", stack)
    (crop,) = stack_folder(tmp_path)
    assert crop.stack(0).names == crop.stack(1).names == bare.names
    assert "shared" not in CropData(stacks, [1, 1]).tensors()


def test_a_layer_of_that_name_in_other_files_is_not_ours():
    colour = ["R", "G", "B", *(f"shared.{c}" for c in "RGB")]
    assert "shared" not in resolve([("", colour)]) and OWN["shared"] == {"primal_var"}
    assert "shared" in resolve([("", colour + [f"primal_var.{c}" for c in "RGB"])])
