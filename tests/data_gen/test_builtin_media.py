"""Built-in scenes with media, and the grids that smoke and clouds are made of."""

import numpy as np
import pytest
from unbiased import load

from data_gen.inspect import inspect_scene
from data_gen.render import render_stack
from data_gen.scenes import builtin, grids

MEDIA = ("haze", "smoke", "cloud")


@pytest.mark.parametrize("name", MEDIA)
def test_a_built_in_scene_with_media_renders(renderer, name):
    """By `gpt`, and by volpathmis alike; without the media it is another image."""
    scene = load(renderer, name, (24, 16))
    stack = render_stack(scene, 16, sampler="gpt", unbiased=True)
    assert "dx" in stack and all(np.isfinite(stack[layer]).all() for layer in stack.names)
    assert np.mean(stack["primal"].max(axis=-1) > 0) > 0.9 and stack.attributes["ngpt:discarded"] == 0
    mis = renderer.load_dict({"type": "volpathmis", "max_depth": 12})
    other = np.array(renderer.render(scene, integrator=mis, spp=32))
    assert np.median(other) == pytest.approx(np.median(stack["primal"]), rel=0.35)
    empty = builtin.SCENES[name]()
    empty["sensor"].pop("medium", None)
    empty.pop(name, None)
    clear = np.array(renderer.render(load(renderer, empty, (24, 16)), spp=64)).mean(axis=-1)
    ratio = np.array(renderer.render(scene, spp=64)).mean(axis=-1) / np.maximum(clear, 1e-3)
    assert np.mean(np.abs(ratio - 1) > 0.15) > 0.05


@pytest.mark.parametrize("name", MEDIA)
def test_inspection_tells_of_media(renderer, name):
    told = inspect_scene(name)
    assert told["media"] and told["plugins"]["medium"] and (name != "haze" or told["plugins"]["emitter"]["spot"] == 1)
    assert not any("pilot" in line for line in told["plan"])  # It has nothing to try in media.
    photons = "media whose density varies: photons are gathered in them by `--sampler bre`"
    assert any(line.endswith(photons) for line in told["plan"]) == (name != "haze")


def test_the_demo_leaves_media_out_by_default():
    assert list(builtin.SURFACES) == ["diffuse", "glossy", "environment", "lens"]
    assert tuple(builtin.MEDIA) == MEDIA and {**builtin.SURFACES, **builtin.MEDIA} == builtin.SCENES


@pytest.mark.parametrize("make", [grids.plume, grids.cloud])
@pytest.mark.parametrize("seed", range(2))
def test_grids_come_from_their_seed_and_end_before_their_box(make, seed):
    grid = make(np.random.default_rng(seed))
    assert grid.dtype == np.float32 and np.array_equal(grid, make(np.random.default_rng(seed)))
    assert not np.array_equal(grid, make(np.random.default_rng(seed + 100)))
    assert grid.min() == 0 and grid.max() == 1 and 0.02 < grid.mean() < 0.4
    assert np.array_equal(grid, np.pad(grid[1:-1, 1:-1, 1:-1], 1))


def test_smoke_rises_from_the_floor():
    grid = grids.plume(np.random.default_rng(3))
    wide = [(level.max(axis=0) > 0.2).sum() for level in grid.swapaxes(0, 1)]  # of each height
    assert 0 < wide[2] < wide[24] and not grid[:, -1].any()


def test_noise_has_the_spectrum_asked_for():
    """Amplitudes over two octaves, averaged over directions."""
    field = grids.noise(np.random.default_rng(0), (32, 32, 32), 2.0)
    assert field.mean() == pytest.approx(0, abs=1e-9) and field.std() == pytest.approx(1)
    power = np.abs(np.fft.fftn(field)) ** 2
    axes = np.meshgrid(*[np.fft.fftfreq(32) * 32] * 3, indexing="ij")
    frequency = np.sqrt(sum(axis**2 for axis in axes))
    near = [power[np.abs(frequency - k) < 0.5].mean() for k in (2, 8)]
    assert np.log2(near[0] / near[1]) / 2 / 2 == pytest.approx(2, abs=0.25)


def test_mitsuba_reads_the_volumes_that_are_written(renderer, tmp_path):
    grid = np.random.default_rng(1).random((3, 4, 5), np.float32)
    grids.write_vol(tmp_path / "a.vol", grid)
    read = renderer.VolumeGrid(str(tmp_path / "a.vol"))
    assert np.array_equal(np.array(read).reshape(grid.shape), grid)
