"""Subpixels: their means are the pixels, they go with these through files and merges, and only with these."""

from dataclasses import replace

import numpy as np
import OpenEXR
import pytest

import ngpt
from ngpt.api.uncertainty import noisier, reconstruct_with_error
from ngpt.denoisers import oidn
from ngpt.errors import NgptError
from ngpt.io.exr import layers_in, read_image, views_in
from ngpt.io.openexr import read_exr, write_exr
from ngpt.merging import merge
from ngpt.methods import reconstruct
from ngpt.panorama import MARGIN, continued, wrapping
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, best, means, spread, stored, subpixels
from ngpt.windows import Place, Window

needs_oidn = pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())


def fine_stack(rng, height=5, width=7, k=2, seed=1, place=None, **attributes):
    """A stack of random light and features with K x K subpixels."""
    fine = {name: stored(name, rng.random((k * height, k * width, 3))) for name in FINE}
    layers = {name: means(layer, k) for name, layer in fine.items()}
    layers["primal_var"] = np.full((height, width, 3), 0.01, np.float32)
    known = {"ngpt:spp": 16, "ngpt:seed": str(seed), "ngpt:sampler": "primal", "ngpt:subpixels": k} | attributes
    return GradientStack(layers, known, path=f"{seed}.exr", place=place, fine=fine)


def same(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


@pytest.mark.parametrize("k", [2, 4])
@pytest.mark.parametrize("size", [(5, 7), (1, 1), (1, 6)])
def test_files_give_back_subpixels_and_their_means(rng, tmp_path, k, size):
    stack = fine_stack(rng, *size, k)
    back = ngpt.read(ngpt.write(tmp_path / "a.exr", stack))
    assert same(back.fine, stack.fine) and same(back.layers, stack.layers)
    assert all(np.array_equal(means(back.fine[name], k), back[name]) for name in FINE)
    again = ngpt.read(ngpt.write(tmp_path / "b.exr", back.replace(depth=np.ones((*size, 1)))))
    assert same(again.fine, stack.fine) and "depth" in again
    result = ngpt.read(ngpt.write(tmp_path / "c.exr", 2 * stack["primal"], like=stack))
    assert same(result.fine, stack.fine) and np.array_equal(result["primal"], stack["primal"])
    assert np.array_equal(read_image(tmp_path / "c.exr"), 2 * stack["primal"])


def test_other_readers_find_the_pixels_in_the_first_part_and_may_ignore_the_other(rng, tmp_path):
    stack = fine_stack(rng)
    with OpenEXR.File(str(ngpt.write(tmp_path / "a.exr", stack)), separate_channels=True) as file:
        first, second = file.parts
        assert np.array_equal(first.channels["R"].pixels, stack["primal"][..., 0])
        assert second.name() == "fine" and second.channels["albedo.G"].pixels.dtype == np.float16
        assert second.channels["R"].pixels.shape == (10, 14) and second.header["ngpt:subpixels"] == 2
    assert layers_in(tmp_path / "a.exr") == {*stack.names} and len(views_in(tmp_path / "a.exr")) == 1


def test_parts_of_a_picture_keep_their_place(rng, tmp_path):
    whole = Window(0, 0, 20, 10)
    stack = fine_stack(rng, place=Place(Window(3, -2, 7, 5), whole))
    back = ngpt.read(ngpt.write(tmp_path / "a.exr", stack))
    assert same(back.fine, stack.fine) and back.place == stack.place


@pytest.mark.parametrize("spoilt", ["a pixel", "a number", "a window"])
def test_subpixels_of_other_pixels_are_left_out_with_a_warning(rng, tmp_path, caplog, spoilt):
    path = ngpt.write(tmp_path / "a.exr", fine_stack(rng))
    image = read_exr(path)
    if spoilt == "a pixel":
        image.parts[0].channels["G"][2, 3] += 1
    elif spoilt == "a number":
        image.parts[1].header["ngpt:subpixels"] = 3
    else:
        image.parts[1].header["dataWindow"] = Window(1, 0, 14, 10).box
    back = ngpt.read(write_exr(path, image, overwrite=True))
    assert not back.fine and "left out" in caplog.text and str(path) in caplog.text
    # What is written of it says nothing of subpixels.
    assert "ngpt:subpixels" not in ngpt.read(ngpt.write(tmp_path / "b.exr", back)).attributes


def test_they_go_where_a_layer_of_theirs_is_replaced(rng):
    stack = fine_stack(rng)
    assert stack.replace(depth=np.ones((5, 7, 1))).fine and not stack.replace(albedo=stack["albedo"]).fine


@pytest.mark.parametrize("wrong", ["shape", "type", "layer", "no primal"])
def test_what_are_no_subpixels_is_refused(rng, wrong):
    stack = fine_stack(rng)
    fine = {
        "shape": {"primal": stack.fine["primal"][:-1]},
        "type": {"primal": stack.fine["primal"].astype(np.float64)},
        "layer": stack.fine | {"depth": stack.fine["primal"]},
        "no primal": {"albedo": stack.fine["albedo"]},
    }[wrong]
    with pytest.raises(NgptError, match=r"1\.exr: the subpixels"):
        replace(stack, fine=fine)


# ------------------------- merging -------------------------


def test_merged_subpixels_are_means_weighted_by_samples(rng):
    one, other = fine_stack(rng), fine_stack(rng, seed=2, **{"ngpt:spp": 48})
    merged = merge([one, other])
    for name in FINE:
        expected = (one.fine[name] + 3.0 * other.fine[name]) / 4
        assert np.allclose(merged.fine[name], expected, atol=1e-3 if name != "primal" else 1e-6)
        assert np.array_equal(means(merged.fine[name], 2), merged[name])
    assert merged.attributes["ngpt:subpixels"] == 2


def test_merged_tiles_are_the_subpixels_of_the_whole(rng):
    stack = fine_stack(rng, 4, 6)
    tiles = []
    for seed, left in enumerate((0, 2)):
        fine = {name: layer[:, 2 * left : 2 * left + 8] for name, layer in stack.fine.items()}
        layers = {name: stack[name][:, left : left + 4] for name in stack.names}
        place = Place(Window(left, 0, 4, 4), Window(0, 0, 6, 4))
        seeds = stack.attributes | {"ngpt:seed": str(seed)}
        tiles.append(GradientStack(layers, seeds, path=f"{seed}.exr", place=place, fine=fine))
    merged = merge(tiles)
    assert same(merged.fine, stack.fine) and np.array_equal(merged["primal"], stack["primal"])


def test_a_pixel_that_one_stack_lost_comes_from_the_other(rng):
    one, other = fine_stack(rng), fine_stack(rng, seed=2)
    fine = {name: layer.copy() for name, layer in one.fine.items()}
    fine["primal"][2:4, 4:6] = np.nan
    lost = one.replace(primal=means(fine["primal"], 2))
    merged = merge([replace(lost, fine=fine), other])
    assert np.isfinite(merged["primal"]).all()
    assert np.array_equal(merged.fine["primal"][2:4, 4:6], other.fine["primal"][2:4, 4:6])


@pytest.mark.parametrize("k", [1, 4])
def test_stacks_of_different_subpixels_merge_without_them_and_say_so(rng, caplog, k):
    other = fine_stack(rng, k=4, seed=2) if k == 4 else replace(fine_stack(rng, seed=2), fine={})
    merged = merge([fine_stack(rng), other])
    assert not merged.fine and "ngpt:subpixels" not in merged.attributes
    told = "4x4" if k == 4 else "none"
    assert f"1.exr has 2x2, 2.exr has {told}" in caplog.text


def test_subpixels_that_are_not_finite_get_all_light_of_their_pixel(rng):
    """With the light of photons, whether it is left to another method or not."""
    stack = fine_stack(rng)
    fine = stack.fine | {"primal": stack.fine["primal"].copy()}
    fine["primal"][2, 3] = np.nan
    light = np.full_like(stack["primal"], 0.25)
    layers = {"primal": means(fine["primal"], 2), "caustic": light, "direct": light}
    given = replace(stack.replace(**layers), fine=fine)
    for gradients in (True, False):
        data = repair(given, gradients)
        pixel = data.image + data.direct + (data.caustic if gradients else 0)
        assert np.allclose(data.fine["primal"][2, 3], pixel[1, 1])
        kept = np.isfinite(fine["primal"])
        assert np.array_equal(data.fine["primal"][kept], fine["primal"][kept])


# ------------------------- methods -------------------------


def edge(rng, k=2, noise=0.3):
    """The stack of a slanted edge between two surfaces, with subpixels."""
    y, x = np.mgrid[0 : 48 * k, 0 : 64 * k] / k
    left = (x + 0.37 * y < 40)[..., None]
    clean = np.where(left, [0.9, 0.2, 0.1], [0.05, 0.3, 0.8]).astype(np.float32)
    noisy = np.maximum(clean * (1 + noise * rng.normal(size=clean.shape)), 0).astype(np.float32)
    albedo = stored("albedo", np.where(left, 0.8, 0.2) * np.ones(3))
    normal = stored("normal", np.where(left, [0.0, 0, 1], [1.0, 0, 0]))
    fine = {"primal": noisy, "albedo": albedo, "normal": normal}
    layers = {name: means(layer, k) for name, layer in fine.items()}
    return GradientStack(layers, {"ngpt:featureNoise": 0.0}, fine=fine)


@needs_oidn
@pytest.mark.parametrize("k", [2, 3, 4])
def test_oidn_takes_the_mean_of_pixels_and_subpixels_of_each_size(rng, k):
    stack = edge(rng, k)
    pixels = repair(replace(stack, fine={}))
    pixels = replace(pixels, features=oidn.prefiltered(pixels.features, "balanced"))
    images = [oidn.oidn(pixels, "clean", "high")]
    for size in {2: (2,), 3: (3,), 4: (4, 2)}[k]:
        fine = {name: means(layer, k // size) for name, layer in stack.fine.items()}
        images.append(reconstruct(replace(stack, fine=fine), "oidn", auxiliary="noisy").image)
    assert np.allclose(reconstruct(stack, "oidn").image, np.mean(images, axis=0), atol=1e-6)


@needs_oidn
def test_the_mean_of_both_sizes_has_less_error_than_either(rng):
    """A slanted edge, and a smooth gradient beside it. Each way has less error elsewhere."""
    stack = edge(rng, noise=1.0)
    clean = edge(rng, noise=0)["primal"]

    def error(image):
        return np.square(image - clean).mean()

    mean = error(reconstruct(stack, "oidn").image)
    pixels = error(reconstruct(replace(stack, fine={}), "oidn").image)
    assert mean < 0.9 * pixels and mean < 0.9 * error(reconstruct(stack, "oidn", auxiliary="noisy").image)


@needs_oidn
@pytest.mark.parametrize("power", [-40, -8, 8, 40])
def test_exposure_of_subpixels(rng, power):
    stack = edge(rng)
    scale = np.float32(2.0**power)
    layers = stack.layers | {"primal": scale * stack["primal"]}
    scaled = GradientStack(layers, stack.attributes, fine=stack.fine | {"primal": scale * stack.fine["primal"]})
    image, other = reconstruct(stack, "oidn").image, reconstruct(scaled, "oidn").image
    assert np.allclose(other / scale, image, rtol=0.01, atol=1e-3)


@needs_oidn
def test_islands_of_a_lightmap_without_features(rng):
    stack = edge(rng)
    alpha = np.zeros((48, 64, 1), np.float32)
    alpha[8:40, 8:50] = 1
    fine = {"primal": stack.fine["primal"] * spread(alpha, 2)}
    some = GradientStack({"primal": means(fine["primal"], 2), "alpha": alpha}, fine=fine)
    image = reconstruct(some, "oidn").image
    whole = reconstruct(GradientStack({"primal": stack["primal"]}, fine={"primal": stack.fine["primal"]}), "oidn").image
    assert not image[:8].any() and np.allclose(image[12:36, 12:40].mean(), whole[12:36, 12:40].mean(), rtol=0.05)


def test_panoramas_continue_by_subpixels(rng):
    stack = wrapping(fine_stack(rng, 3, 200))
    wide = continued(stack)
    assert wide.fine["primal"].shape == (6, 2 * (200 + 2 * MARGIN), 3)
    for name in FINE:
        assert np.array_equal(means(wide.fine[name], 2), wide[name])


@needs_oidn
def test_standard_errors_are_of_the_image_by_subpixels(rng):
    """Noise is added to subpixels too, with the variance that they have."""
    stack = edge(rng)
    k, noise = 2, 0.3
    variance = np.square(noise * stack["primal"]) / k**2
    stack = replace(stack.replace(primal_var=variance), fine=stack.fine)
    again = noisier(stack)
    assert np.array_equal(means(again.fine["primal"], k), again["primal"])
    added = again.fine["primal"] - stack.fine["primal"]
    expected = np.square(noise) * np.square(spread(stack["primal"], k))
    assert 0.9 < np.mean(np.square(added)) / np.mean(expected) < 1.1
    assert 0.9 < np.mean(np.square(again["primal"] - stack["primal"])) / np.mean(variance) < 1.1
    assert np.isfinite(reconstruct_with_error(stack, "oidn").error).all()


@needs_oidn
def test_networks_read_oidns_image_of_subpixels(rng):
    stack = edge(rng)
    more = {"depth": np.ones((48, 64, 1)), "primal_var": 0.01 * stack["primal"] ** 2 + 1e-6}
    stack = replace(stack.replace(**more), fine=stack.fine)
    by_subpixels, by_pixels = (reconstruct(one, "ngpt-primal").image for one in (stack, replace(stack, fine={})))
    assert not np.array_equal(by_subpixels, by_pixels)


def test_the_rule_goes_by_paths_per_pixel():
    assert best(1) == 1 and best(1 << 20) == 2 == best(None)
    assert subpixels({}, 7) == 1
