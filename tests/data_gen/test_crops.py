"""Crops of training sets: shots whose motion is true and scenes that stay, inputs with uneven samples, and repairs."""

from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest
from full_stack import full_stack
from unbiased import load

from ngpt.merging import merge
from ngpt.methods import reconstruct
from ngpt.sequence.warp import warped
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, means, spread, stored
from ngpt.training.dataset import Dataset, problems

pytest.importorskip("mitsuba")
pytest.importorskip("safetensors")

from data_gen.dataset import cameras, crops, jobs, movement
from data_gen.dataset.card import write_card
from data_gen.dataset.config import DatasetConfig
from data_gen.render import render_stack
from data_gen.scenes import load as loading
from data_gen.scenes.geometry import VERTICES

SHOT = {"size": 24, "frames": 3}
SHARED_OUT = {"inputs": 2, "spp": (32, 64)}


@pytest.fixture(scope="module")
def around(renderer, first_view):
    """The surroundings of a painted room with a box and a lamp in it."""
    mi = renderer
    t = mi.ScalarTransform4f

    def painted(seed):
        pixels = np.random.default_rng(seed).random((5, 5, 3)).astype(np.float32)
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
        return {"paint": {"type": "diffuse", "reflectance": texture}}

    walls = {
        f"wall{i}": {"type": "rectangle", "to_world": t().rotate([0, 1, 0], 90 * i).translate([0, 0, -4]).scale(4)}
        | painted(i)
        for i in range(4)
    }
    scene = {
        "type": "scene",
        "camera": {"type": "thinlens", "fov": 60, "aperture_radius": 0.01, "focus_distance": 4.0},
        "sky": {"type": "constant", "radiance": 0.3},
        "lamp": {"type": "sphere", "radius": 0.3, "center": [0, 3, 0], "e": {"type": "area", "radiance": 9.0}},
        "box": {"type": "cube", "to_world": t().translate([1, 0, 1]).scale(0.7)} | painted(9),
        **walls,
    }
    return cameras.Surroundings(load(mi, scene))


def config_of(**changes):
    settings = {"size": 16, "inputs": 1, "spp": (2, 2), "sampler": "primal", "reference_method": "primal"}
    return DatasetConfig(**(settings | {"scenes": 1, "reference_spp": 4, "roll": 0.0} | changes))


@pytest.fixture
def made_set(around, tmp_path, monkeypatch):
    """Makes a set whose only scene is the room, and reads it."""
    monkeypatch.setattr(cameras, "Surroundings", lambda scene, box: around)
    monkeypatch.setattr(loading, "load_scene", lambda *arguments, merged: None)
    monkeypatch.setattr(crops, "made_scene", lambda *arguments: None)
    # The room outlives its shards, and so must its kernels: Dr.Jit ends the process where they are gone.
    monkeypatch.setattr("drjit.flush_kernel_cache", lambda: None)

    def make(**changes):
        jobs.generate(config_of(**changes), tmp_path, jobs.Serial())
        assert problems(tmp_path) == []
        return Dataset(tmp_path)

    return make


def state(mi, scene):
    """All that can be moved or shine, but the camera."""
    params = mi.traverse(scene)
    kinds = (".to_world", *(f".{name}" for name in VERTICES), ".value", ".radiance.value")
    names = [name for name in params.keys() if name.endswith(kinds) and "camera" not in name]  # noqa: SIM118
    return {name: np.array(getattr(params[name], "matrix", params[name])) for name in names}


def test_what_is_seen_was_seen_there_and_the_scene_stays(renderer, around, monkeypatch):
    """Along motion, the frame before has the colours of this one, but for edges."""
    for share in ("CAMERA", "THING", "LIGHT"):
        monkeypatch.setattr(movement, share, 1.0)
    before = state(renderer, around.scene)
    moved, kinds = [], set()
    for crop in range(3):
        made = crops.make_crop(config_of(**SHOT), around, "x", crop)
        assert [told["frame"] for _, told in made] == [0, 1, 2]
        assert np.isnan(made[0][0].motion).all()
        kinds |= {kind for kind in ("shape", "light") if made[0][1]["movement"][kind]}
        for (last, _), (now, _) in pairwise(made):
            colours, found = warped(last.stacks[0]["albedo"], now.motion)
            if found.mean() > 0.3:
                difference = np.abs(colours - now.stacks[0]["albedo"]).max(axis=-1)[found]
                assert np.median(difference) < 0.03
                moved.append(float(np.nanmedian(np.linalg.norm(now.motion, axis=-1))))
    assert kinds == {"shape", "light"} and len(moved) >= 4 and max(moved) > 4 * min(moved)
    after = state(renderer, around.scene)
    assert all(np.allclose(after[name], value, atol=1e-6) for name, value in before.items())


def test_one_frame_is_the_crop_it_was(around):
    """A crop of one frame draws no further random numbers and records nothing of shots."""
    config = config_of(size=24)
    ((data, told),) = crops.make_crop(config, around, "x", 3)
    assert data.motion is None and not {"frame", "movement"} & told.keys()
    rng = np.random.default_rng((*crops.scene_seed(config, "x"), 3))
    rng.random()  # for the number of samples
    view = cameras.find_view(around, rng, config.size, config.roll, config.lens)
    view.apply(around.scene)
    seed = int(rng.integers(0, 2**32, 3)[0])
    assert told["view"] == asdict(view) and told["seeds"][0] == seed
    stack = render_stack(around.scene, 2, seed, "primal", unbiased=True, made=around.made)
    assert np.array_equal(data.stacks[0]["primal"], stack["primal"])


def test_a_set_of_shots(made_set, tmp_path):
    data = made_set(frames=2, crops=2)
    assert data.shots == (range(2), range(2, 4)) and data.manifest["planned"] == 4
    write_card(tmp_path)
    assert "2 shots of up to 2 frames: 4 crops of 16x16 pixels" in (tmp_path / "README.md").read_text()


def test_uneven_inputs_beside_the_same_views_seeds_and_references(around):
    ((even, told),) = crops.make_crop(config_of(**SHARED_OUT), around, "x", 0)
    ((uneven, told_uneven),) = crops.make_crop(config_of(**SHARED_OUT, adaptive=1.0), around, "x", 0)
    assert "adaptive" not in told and told_uneven["adaptive"] == [True, True]
    assert told_uneven["seeds"] == told["seeds"] and told_uneven["view"] == told["view"]
    assert np.array_equal(uneven.reference, even.reference)
    for spp, before, stack in zip(even.spp, even.stacks, uneven.stacks, strict=True):
        samples = stack["samples"]
        assert "samples" not in before and not np.array_equal(stack["primal"], before["primal"])
        assert samples.min() >= 16 and np.ptp(samples) > 0 and np.all(samples % 16 == 0)
        assert spp - 16 < samples.mean() <= spp
    assert merge(uneven.stacks)["samples"].sum() == sum(stack["samples"].sum() for stack in uneven.stacks)


def test_the_share_of_uneven_inputs():
    """By random numbers of their own; too few samples stay even."""
    config = config_of(inputs=2, adaptive=0.25, spp=(2, 64))
    drawn, again = ([crops.uneven_inputs(config, "x", crop, [31, 32, 64]) for crop in range(400)] for _ in range(2))
    few, *enough = np.mean(drawn, axis=0)
    # Standard deviation of a mean of 400: 0.022
    assert drawn == again and few == 0 and all(abs(share - 0.25) < 4 * 0.022 for share in enough)
    assert crops.uneven_inputs(config_of(), "x", 0, [32, 64]) == [False, False]


def test_a_set_of_both_kinds_by_a_sampler_without_gradients(made_set, monkeypatch):
    """All inputs have the layer ``samples`` then, so that crops of either kind fit into one shard."""
    monkeypatch.setattr(crops, "uneven_inputs", lambda config, name, crop, counts: [False, crop == 1])
    data = made_set(**SHARED_OUT, adaptive=0.5, crops=2)
    spread = [[float(np.ptp(crop.stack(k)["samples"])) for k in range(2)] for crop in data]
    assert [[s > 0 for s in row] for row in spread] == [[False, False], [False, True]]
    for crop in data:
        assert crop.stack(0)["samples"].shape == (16, 16, 1)
        assert np.all(crop.stack(0)["samples"] == crop.spp[0])
    shard = data[0].shard
    assert shard.shape("primal_se")[1:] == (2, 16, 16, 3) and "dx" not in shard.names


@pytest.mark.parametrize("changes", [{"sampler": "gpt"}, {"adaptive": 0.5, **SHARED_OUT}, {"frames": 2}])
def test_a_set_with_subpixels(made_set, changes, tmp_path):
    """Those of the same renders, whatever else the set asks for; pixels are their means, to the bit."""
    data = made_set(crops=1, subpixels=2, **changes)
    for crop in data:
        for k in range(crop.inputs):
            stack = crop.stack(k)
            assert set(stack.fine) == set(FINE) and stack.number("ngpt:featureNoise") is not None
            for name in FINE:
                assert stack.fine[name].shape == (32, 32, 3) and stack.fine[name].std() > 0
                assert np.array_equal(means(stack.fine[name], 2), stack[name])
    write_card(tmp_path)
    assert f"{crop.inputs} inputs each, with 2x2 subpixels;" in (tmp_path / "README.md").read_text()


def test_views_and_references_are_those_without_subpixels(around):
    ((plain, told),) = crops.make_crop(config_of(size=24), around, "x", 0)
    ((data, told_fine),) = crops.make_crop(config_of(size=24, subpixels=2), around, "x", 0)
    assert told_fine["view"] == told["view"] and told_fine["seeds"] == told["seeds"]
    assert np.array_equal(data.reference, plain.reference) and not plain.stacks[0].fine
    stack = render_stack(around.scene, 2, told["seeds"][0], "primal", unbiased=True, subpixels=2)
    assert all(np.array_equal(data.stacks[0].fine[name], stack.fine[name]) for name in FINE)
    assert np.allclose(data.stacks[0]["primal"], plain.stacks[0]["primal"], rtol=1e-5)


def test_repaired_inputs_keep_their_subpixels():
    stack = full_stack(20, 24)
    stack = stack.replace(direct=0 * stack["primal"])
    fine = {name: stored(name, spread(stack[name], 2)) for name in FINE}
    fine["primal"][7, 9] = fine["albedo"][30, 31] = np.nan
    given = replace(stack.replace(**{name: means(layer, 2) for name, layer in fine.items()}), fine=fine)
    made, bad = crops.finite(given)
    assert bad >= 1
    for name in FINE:
        assert np.isfinite(made.fine[name]).all() and np.array_equal(means(made.fine[name], 2), made[name])
    assert np.array_equal(made.fine["primal"][:6], fine["primal"][:6])


def test_sample_counts_are_stratified():
    config = config_of(inputs=5, spp=(2, 1023))
    counts = np.array([crops.sample_counts(np.random.default_rng(i), config) for i in range(400)])
    assert counts.min() >= 2 and counts.max() <= 1023
    assert np.all(np.diff(counts, axis=1) >= 0)
    edges = np.exp(np.linspace(np.log(2), np.log(1024), 6))
    assert np.all((counts + 1 > edges[:-1]) & (counts <= edges[1:]))


def test_crops_keep_light_that_gradients_lack_apart():
    """It is made finite as the rest is; networks that read gradients have targets without it."""
    stack = full_stack(20, 24)
    light = np.zeros_like(stack["primal"])
    light[::4, ::5] = 6
    primal = stack["primal"] + light
    primal[3, 4], light[10, 12] = np.nan, np.inf
    given = stack.replace(primal=primal, direct=0 * primal, caustic=light, caustic_var=light**2)
    made, bad = crops.finite(given)
    assert bad >= 2 and all(np.isfinite(made[name]).all() for name in made.names)
    same = np.isfinite(given["primal"]).all(axis=-1) & np.isfinite(given["caustic"]).all(axis=-1)
    for name in ("primal", "caustic"):
        assert np.allclose(made[name][same], given[name][same], rtol=1e-5)
    rest, apart = crops.references(made, "wcv")
    assert apart.sum(dtype=np.float64) == pytest.approx(made["caustic"].sum(dtype=np.float64), rel=1e-3)
    assert np.allclose(rest + apart, reconstruct(made, "wcv").image, rtol=1e-5, atol=1e-5)
    assert crops.references(stack, "wcv")[1] is None


def test_crops_keep_split_light():
    """Made finite as the rest is: pixels come from their neighbours, and what is not known of a variance is its own."""
    stack = full_stack(20, 24)
    layers = {name: stack[name].copy() for name in ("primal", "primal_var", "albedo", "normal", "depth")}
    layers |= {"direct": 0 * stack["primal"], "diffuse": stack["primal"] / 4, "specular": 0.75 * stack["primal"]}
    layers |= {f"{name}_var": 0.1 * layers[name] ** 2 for name in ("diffuse", "specular")}
    layers["primal"][3, 4] = layers["specular"][3, 4] = np.nan
    layers["diffuse_var"][10, 12] = np.inf
    given = GradientStack(layers)
    made, bad = crops.finite(given)
    assert bad >= 2 and made.names == given.names and all(np.isfinite(made[name]).all() for name in made.names)
    around = layers["specular"][2:5, 3:6]
    assert np.nanmin(around) < made["specular"][3, 4].mean() < np.nanmax(around)
    assert np.allclose(made["diffuse_var"][10, 12], layers["diffuse"][10, 12] ** 2)
    assert np.array_equal(made["diffuse"][:3], layers["diffuse"][:3])
