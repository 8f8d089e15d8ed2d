"""Merged stacks against statistics of all samples at once."""

import json

import numpy as np
import pytest
from shots import part_of

import ngpt
from ngpt.api.uncertainty import known_noise
from ngpt.classical.gradients import forward_differences
from ngpt.errors import NgptError
from ngpt.io.exr import pass_through, with_channels
from ngpt.merging import merge
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

SHAPE = (5, 4, 3)


def stack_of(samples, seed, gradients=True, **attributes):
    """The stack of samples (spp, H, W, 3), with gradients that are twice the primal."""
    spp = len(samples)
    layers = {"primal": samples.mean(axis=0)}
    if gradients:
        layers |= {"dx": 2 * layers["primal"], "dy": -2 * layers["primal"]}
    if spp > 1:
        variance = samples.var(axis=0, ddof=1) / spp
        layers |= {f"{name}_var": variance * (1 if name == "primal" else 4) for name in list(layers)}
    known = {"ngpt:spp": spp, "ngpt:seed": str(seed), "ngpt:sampler": "gpt", "ngpt:seconds": 1.5}
    return GradientStack.from_arrays(path=f"{seed}.exr", attributes=known | attributes, **layers)


@pytest.mark.parametrize("counts", [(4, 4), (1, 7), (1, 1), (3, 1, 12)])
def test_merged_stacks_are_the_stack_of_all_samples(rng, counts):
    samples = 5 + rng.normal(size=(sum(counts), *SHAPE))
    parts = np.split(samples, np.cumsum(counts)[:-1])
    merged = merge([stack_of(part, seed) for seed, part in enumerate(parts)])
    whole = stack_of(samples, 0)
    assert merged.names == whole.names
    for name in whole.names:
        assert np.allclose(merged[name], whole[name], rtol=1e-5, atol=1e-7), name
    assert merged.attributes["ngpt:spp"] == sum(counts)
    assert merged.attributes["ngpt:seed"] == " ".join(str(i) for i in range(len(counts)))
    assert merged.attributes["ngpt:seconds"] == 1.5 * len(counts)


def test_noise_of_features_falls_with_the_samples(rng):
    noise = "ngpt:featureNoise"
    a, b = (stack_of(rng.random((n, *SHAPE)), n, **{noise: 0.3 / n}) for n in (2, 4))
    assert merge([a, b]).attributes[noise] == pytest.approx(0.3 / 6)
    places = (Place(Window(x, 0, 4, 5), Window(0, 0, 8, 5)) for x in (0, 4))
    tiles = [GradientStack(s.layers, s.attributes, place=at) for s, at in zip((a, b), places, strict=True)]
    assert merge(tiles).attributes[noise] == pytest.approx((0.3 / 2 + 0.3 / 4) / 2)
    assert noise not in merge([a, stack_of(rng.random((3, *SHAPE)), 7)]).attributes
    assert noise not in merge([stack_of(rng.random((3, *SHAPE)), 7), a]).attributes


def test_a_part_that_was_broken_off_is_named(rng, tmp_path, command):
    samples = 5 + rng.normal(size=(6, *SHAPE))
    ngpt.write(tmp_path / "a.exr", stack_of(samples[:2], 1, **{"ngpt:unfinished": "interrupted"}))
    ngpt.write(tmp_path / "b.exr", stack_of(samples[2:], 2))
    told = command("merge a.exr b.exr -o all.exr").err
    assert "a.exr: was interrupted at 2 samples per pixel; " in told and "b.exr: was" not in told
    assert "ngpt:unfinished" not in ngpt.read("all.exr").attributes


def test_pixels_without_samples_count_nothing(rng):
    a, b = (stack_of(rng.random((4, *SHAPE)), seed) for seed in range(2))
    for name in ("primal", "primal_var"):
        a.layers[name][1, 2] = np.nan
    b.layers["primal"][0, 0] = np.inf
    merged = merge([a, b])
    assert np.array_equal(merged["primal"][1, 2], b["primal"][1, 2])
    assert np.allclose(merged["primal_var"][1, 2], b["primal_var"][1, 2], rtol=1e-6)
    assert np.isposinf(merged["primal"][0, 0]).all()
    assert np.isfinite(merged["primal"][2:]).all()


def parts(stack, seed, *windows):
    """Tiles of a stack, with seeds and names of their own."""
    tiles = [part_of(stack, *window) for window in windows]
    for i, tile in enumerate(tiles):
        tile.attributes["ngpt:seed"], tile.path = str(seed + i), f"tile{i}.exr"
    return tiles


LARGE = (9, 12, 3)


def stack_with(rng, seed=1, shape=SHAPE, gradients=True, **attributes):
    """A stack of noise with other attributes of ngpt, without those that are None."""
    stack = stack_of(rng.random((4, *shape)), seed, gradients)
    stack.attributes |= {f"ngpt:{name}": value for name, value in (attributes | {"seed": seed}).items()}
    stack.attributes = {name: value for name, value in stack.attributes.items() if value is not None}
    return stack


# What the second of two stacks has -> what is said of it.
PAIRS = {
    "another size": ({"shape": (5, 6, 3)}, "2.exr is 6x5 but 1.exr is 4x5"),
    "fewer layers": ({"gradients": False}, "1.exr has 'd[xy]' and 2.exr has not"),
    "the same seed": ({"seed": "7 1"}, "both rendered with seed 1"),
    "no seed": ({"seed": None}, "has no attribute 'ngpt:seed'"),
    "no count": ({"spp": None}, "2.exr: has no attribute 'ngpt:spp'"),
    "no samples": ({"spp": 0}, "2.exr: attribute 'ngpt:spp' is 0, so its weight is not known"),
    "a count in words": ({"spp": "16"}, "2.exr: attribute 'ngpt:spp' is '16', so its weight is not known"),
    "another sampler": ({"sampler": "primal"}, "2.exr was made by sampler 'primal' and 1.exr by 'gpt'"),
    "another frame": ({"frame": 4}, "stacks of one frame"),
    "no time": ({"seconds": "long"}, "2.exr: attribute 'ngpt:seconds' is 'long', and no number that can be merged"),
    "negative": ({"discarded": -1.0}, "2.exr: attribute 'ngpt:discarded' is -1.0, and no number that can be merged"),
    "noise in words": ({"featureNoise": "low"}, "attribute 'ngpt:featureNoise' is 'low'"),
}


def with_counts(stack, value):
    counts = np.full((*SHAPE[:2], 1), 4, np.float32)
    counts[2, 1] = value
    return stack.replace(samples=counts)


def refused():
    """Name -> stacks, and what is said of them."""
    rng = np.random.default_rng(0)
    one, two = (stack_with(rng, seed) for seed in (1, 2))
    found = {"one": ([one], "at least two stacks, and got 1")}
    for name, (wrong, message) in PAIRS.items():
        known = {option: 1 for option in wrong if option in ("discarded", "featureNoise", "frame")}
        other = stack_with(rng, **({"seed": 2} | wrong))
        other.path = "2.exr"
        found[name] = [stack_with(rng, **known), other], message
    unknown = GradientStack({name: two[name] for name in two if "_var" not in name}, two.attributes, path="2.exr")
    found["no variance"] = [one, unknown], "2.exr has no 'primal_var' though it has 4 samples"
    strange = [with_channels(stack, {"id": np.zeros(SHAPE[:2])}) for stack in (one, two)]
    found["a strange channel"] = strange, "channel 'id' has no mean"
    no_number = r"2.exr: layer 'samples' has .* at pixel \(1, 2\), and 1 of 20 pixels are no"
    for value in (np.nan, -1, 1e30):
        found[f"counts of {value}"] = [one, with_counts(two, value)], no_number
    none = [stack.replace(samples=np.zeros(SHAPE[:2])) for stack in (one, two)]
    found["counts of 0"] = none, "layer 'samples' is 0 in all pixels"
    far, whole = [stack_with(rng, seed, LARGE) for seed in range(2)], stack_with(rng, 0, LARGE)
    for tile, corner in zip(far, (0, 2**30), strict=True):
        tile.place = Place(Window(corner, corner, 12, 9), Window(0, 0, 2**31, 2**31))
    found["far apart"] = far, r"no stack has all pixels of 1073741836x1073741833 at \(0, 0\)"
    overlapping = parts(whole, 1, (0, 0, 5, 9), (4, 0, 8, 9))
    for tile in overlapping:
        tile.attributes["ngpt:seed"] = "3"
    found["overlapping"] = overlapping, "both rendered with seed 3"
    hole, (tile,) = parts(whole, 1, (0, 0, 5, 9), (5, 0, 7, 5)), parts(whole, 1, (0, 0, 4, 5))
    found["a hole"] = hole, r"no stack has all pixels of 7x4 at \(5, 5\): tile0.exr 5x9 at \(0, 0\), tile1"
    found["a whole"] = (
        [tile, two],
        r"2.exr is 4x5 but tile0.exr is 4x5 at \(0, 0\) of 12x9; merge seeds or tiles",
    )
    return found


@pytest.mark.parametrize(("stacks", "message"), refused().values(), ids=refused())
def test_stacks_that_cannot_be_merged(stacks, message):
    with pytest.raises(NgptError, match=message):
        merge(stacks)


def test_results_are_not_merged(rng, tmp_path):
    stacks = [stack_with(rng, seed) for seed in range(2)]
    paths = [ngpt.write(tmp_path / f"{i}.exr", ngpt.denoise(s, "l2"), like=s) for i, s in enumerate(stacks)]
    with pytest.raises(NgptError, match="before they are reconstructed"):
        merge([ngpt.read(path) for path in paths])


def test_command(rng, tmp_path, command):
    stacks = [stack_with(rng, seed) for seed in range(3)]
    for i, stack in enumerate(stacks):
        ngpt.write(tmp_path / f"{i}.exr", with_channels(stack, {"diagnostics.discarded": np.full(SHAPE[:2], i / 4)}))
    report, merged = json.loads(command("merge 0.exr 1.exr 2.exr -o out.exr --json").out), ngpt.read("out.exr")
    assert report["spp"] == merged.attributes["ngpt:spp"] == 12 and report["seed"] == "0 1 2"
    assert np.allclose(merged["dx"], sum(stack["dx"] for stack in stacks) / 3, atol=1e-6)
    assert np.allclose(pass_through(merged)["diagnostics.discarded"], 0.25)
    assert "discarded" in command("info out.exr").out


def test_pixels_with_samples_in_different_numbers(rng):
    """Each pixel as if it were merged alone; a film of all samples has the same primal."""
    samples = 5 + rng.normal(size=(40, *SHAPE))
    counts = rng.integers(2, 9, size=(3, *SHAPE[:2], 1))
    stacks, begin = [], np.zeros((*SHAPE[:2], 1), int)
    number = np.arange(40)[:, None, None, None]
    for seed, n in enumerate(counts):
        of_part = (number >= begin) & (number < begin + n)
        mean = np.where(of_part, samples, 0).sum(axis=0) / n
        variance = np.where(of_part, (samples - mean) ** 2, 0).sum(axis=0) / (n - 1) / n
        known = {"ngpt:spp": 5, "ngpt:seed": str(seed), "ngpt:sampler": "gpt"}
        layers = {"primal": mean, "primal_var": variance, "samples": n.astype(np.float32)}
        stacks.append(GradientStack.from_arrays(attributes=known, **layers))
        begin = begin + n
    merged, total = merge(stacks), counts.sum(axis=0)
    of_all = number < total
    mean = np.where(of_all, samples, 0).sum(axis=0) / total
    assert np.array_equal(merged["samples"], total)
    assert merged.attributes["ngpt:spp"] == round(total.mean())
    assert np.allclose(merged["primal"], mean, rtol=1e-5)
    expected = np.where(of_all, (samples - mean) ** 2, 0).sum(axis=0) / (total - 1) / total
    assert np.allclose(merged["primal_var"], expected, rtol=1e-4)


def test_merged_differences_of_uneven_counts_have_the_right_variance(rng):
    """Directions with other variances and counts in each stack: the merged variance is that of the merged mean."""
    deviation, runs = np.array([1.0, 3.0]), 4000
    counts = [np.array([4, 32]), np.array([16, 16]), np.array([32, 2])]
    means, variances = [], []
    known, one = {"ngpt:spp": 16, "ngpt:sampler": "gpt"}, np.ones((200, 2, 3))
    for _ in range(runs // 200):
        stacks = []
        for seed, n in enumerate(counts):
            # 200 rows, each an experiment of its own, of pairs of pixels.
            each = [deviation[i] * rng.normal(size=(200, n[i])) for i in range(2)]
            dx, var = np.zeros((2, 200, 2, 3))
            dx[:, 0] = ((each[0].mean(axis=1) - each[1].mean(axis=1)) / 2)[:, None]
            var[:, 0] = (sum(e.var(axis=1, ddof=1) / e.shape[1] for e in each) / 4)[:, None]
            layers = {"primal": one, "primal_var": 0 * one, "dx": dx, "dx_var": var}
            layers["samples"] = np.broadcast_to(n[:, None], (200, 2, 1)).astype(np.float32)
            stacks.append(GradientStack.from_arrays(attributes=known | {"ngpt:seed": str(seed)}, **layers))
        merged = merge(stacks)
        means.append(merged["dx"][:, 0, 0])
        variances.append(merged["dx_var"][:, 0, 0])
    assert np.mean(variances) == pytest.approx(np.var(means), rel=0.08)


def test_merged_differences_are_weighted_by_their_precision(rng):
    """A mean over n samples of one pixel less one over m of the other has a variance of 1 / n + 1 / m of theirs."""
    stacks = [
        stack_of(rng.random((4, *SHAPE)), seed).replace(samples=rng.integers(1, 40, (*SHAPE[:2], 1)))
        for seed in range(2)
    ]
    merged = merge(stacks)
    for name, here, there in (("dx", np.s_[:, :-1], np.s_[:, 1:]), ("dy", np.s_[:-1], np.s_[1:])):
        precision = [1 / (1 / stack["samples"][here] + 1 / stack["samples"][there]) for stack in stacks]
        expected = sum(p * stack[name][here] for p, stack in zip(precision, stacks, strict=True)) / sum(precision)
        assert np.allclose(merged[name][here], expected, rtol=1e-5), name


def test_tiles_are_put_together(rng):
    """They are the whole, but for the differences across their borders, which none of them knows."""
    whole = stack_of(rng.random((4, *LARGE)), 0)
    for layer in (whole["dx"][:, -1], whole["dx_var"][:, -1], whole["dy"][-1], whole["dy_var"][-1]):
        layer[:] = 0
    merged = merge(parts(whole, 7, *[(x, y, 6, 4 + (y > 0)) for y in (0, 4) for x in (0, 6)]))
    assert merged.place == whole.place and merged.attributes["ngpt:seed"] == "7 8 9 10"
    assert merged.attributes["ngpt:seconds"] == 4 * whole.attributes["ngpt:seconds"]
    for name in ("dx", "dx_var"):
        whole[name][:, 5] = np.nan
    for name in ("dy", "dy_var"):
        whole[name][3] = np.nan
    for name in whole.names:
        np.testing.assert_allclose(merged[name], whole[name], rtol=1e-6, err_msg=name)
    assert "samples" not in merged


def test_tiles_that_overlap_are_averaged_by_samples(rng):
    few, many = rng.normal(5, 1, (3, *LARGE)), rng.normal(5, 1, (8, *LARGE))
    (left,), (right,) = parts(stack_of(few, 0), 1, (0, 0, 8, 9)), parts(stack_of(many, 0), 2, (5, 0, 7, 9))
    merged, both = merge([left, right]), stack_of(np.concatenate([few, many]), 0)
    assert merged["samples"][0, :, 0].tolist() == 5 * [3] + 3 * [11] + 4 * [8]
    assert merged.attributes["ngpt:spp"] == round((5 * 3 + 3 * 11 + 4 * 8) / 12)
    for name in ("primal", "primal_var", "dy"):
        for columns, known in ((np.s_[:5], left), (np.s_[5:8], both), (np.s_[8:], None)):
            expected = (right[name][:, 3:] if known is None else known[name][:, columns])[:-1]
            assert np.allclose(merged[name][:-1, columns], expected, rtol=1e-5), name
    # What a tile does not know at its border, the other does.
    assert np.allclose(merged["dx"][:, 7], right["dx"][:, 2], rtol=1e-5)
    assert np.allclose(merged["dx_var"][:, 7], right["dx_var"][:, 2], rtol=1e-5)
    assert np.allclose(merged["dx"][:, 4], left["dx"][:, 4], rtol=1e-5)


def test_tiles_with_seeds_of_their_own_are_merged_like_others(rng):
    whole, other = (stack_of(rng.random((4, *LARGE)), seed) for seed in (0, 50))
    tiles, more = parts(whole, 7, (0, 0, 5, 9), (5, 0, 7, 9)), parts(other, 20, (0, 0, 5, 9), (5, 0, 7, 9))
    at_once, in_turn = merge([*tiles, *more]), merge([merge(tiles), merge(more)])
    for name in at_once.names:
        assert np.allclose(at_once[name], in_turn[name], rtol=1e-5, atol=1e-7, equal_nan=True), name
    for tile in tiles:
        tile.attributes["ngpt:seed"] = "3"
    assert merge(tiles).attributes["ngpt:seed"] == "3"  # they share a seed, but no samples
    part = part_of(whole, 5, 0, 7, 9)
    assert merge([part, other, tiles[0]]).place == whole.place


@pytest.mark.parametrize("method", ["l2", "wcv", "ngpt-fast"])
def test_merged_tiles_have_no_seams(rng, method):
    """A slope of 0 across a border would show as a step of 0.05 to 0.08. Of tiles that overlap all slopes are known."""
    y, x = np.mgrid[:32, :48]
    truth = np.repeat((1 + 0.08 * x + 0.05 * y)[..., None], 3, axis=-1)
    noise = {"primal": 0.2, "dx": 0.02, "dy": 0.02}
    layers = dict(zip(noise, (truth, *forward_differences(truth)), strict=True))
    layers = {name: layer + rng.normal(0, noise[name], truth.shape) for name, layer in layers.items()}
    layers |= {f"{name}_var": np.full(truth.shape, sigma**2) for name, sigma in noise.items()}
    layers |= {"albedo": 0 * truth + 0.5, "normal": 0 * truth + [0.0, 0.0, 1.0], "depth": np.ones(truth.shape[:2])}
    known = {"ngpt:spp": 4, "ngpt:seed": "0", "ngpt:sampler": "gpt"}
    whole = GradientStack({name: layer.astype(np.float32) for name, layer in layers.items()}, known)
    expected = reconstruct(whole, method).image
    for overlap in (0, 1):
        windows = [(x, y, 24 + overlap * (x == 0), 16 + overlap * (y == 0)) for y in (0, 16) for x in (0, 24)]
        merged = merge(parts(whole, 1, *windows))
        image = reconstruct(merged, method).image
        for axis, seam in ((1, 23), (0, 15)):
            assert np.abs(np.diff(image - truth, axis=axis).mean(axis=(1 - axis, 2)))[seam] < 0.035
        assert np.square(image - truth).mean() < (1.1 if overlap else 1.5) * np.square(expected - truth).mean()
        assert known_noise(merged).all()  # the noise of differences that are left out does not matter


def test_tiles_from_files_keep_what_else_they_carry(rng, tmp_path, command):
    """Diagnostics, samples that differ, motion; of frames that lie beyond the display window too."""
    whole = stack_of(rng.random((4, *LARGE)), 0, **{"ngpt:frame": 2})
    motion = rng.normal(size=(*LARGE[:2], 2)).astype(np.float32)
    motion[2, 7] = np.nan
    whole = whole.replace(motion=motion, samples=rng.integers(2, 9, LARGE[:2]))
    whole.place = Place(Window(-2, -3, 12, 9), Window(0, 0, 8, 4))
    rates = rng.random(LARGE[:2]).astype(np.float32)
    for tile in parts(whole, 1, (-2, -3, 5, 9), (3, -3, 7, 9)):
        there = tile.place.data.within(whole.place.data)
        ngpt.write(tmp_path / tile.path, with_channels(tile, {"diagnostics.discarded": rates[there]}))
    command("merge tile0.exr tile1.exr -o merged.exr")
    merged = ngpt.read("merged.exr")
    assert merged.place == whole.place and merged.attributes["ngpt:frame"] == 2
    assert np.array_equal(merged["motion"], motion, equal_nan=True)
    assert np.array_equal(merged["samples"], whole["samples"])
    assert np.array_equal(pass_through(merged)["diagnostics.discarded"], rates)
