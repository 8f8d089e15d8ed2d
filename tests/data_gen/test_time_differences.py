"""Differences in time from paired samples: their mean, how little they vary, and where they are not known."""

import mitsuba as mi
import numpy as np
import pytest
from rendered_once import rendered_once
from shared_tails import blocks

from data_gen.frames.motion import motion_vectors
from data_gen.render import render_stack
from ngpt.testing import z_test

SIZE = (24, 16)


def moving(scene, camera=0.0, **moved):
    """A shot of a built-in scene whose camera goes to the right, and whose shapes go somewhere, by so much a frame."""
    from data_gen.frames.shot import Shot

    start = {}

    def update(params, frame):
        for name, way in ({"sensor": (camera, 0, 0)} | moved).items():
            key = f"{name}.to_world"
            start.setdefault(key, mi.Transform4f(params[key]))
            there = mi.Transform4f(mi.ScalarTransform4f().translate([frame * step for step in way]))
            params[key] = there @ start[key]

    return Shot(lambda frame: (scene, {}), SIZE, update=update)


class Estimates:
    """dt of frame 1 with ``count`` seeds, its variances, and the frame's light.

    ``apart``  what the seeds of the frame before differ by: samples are in pairs if it is 0
    """

    def __init__(self, shot, count, pairs, first=0, apart=0):
        from data_gen.frames.time_differences import difference, light

        before, now = shot.snapshot(0), shot.snapshot(1)
        motion = motion_vectors(shot.at(1), now, before)
        here = [light(shot.at(1), first + seed, pairs) for seed in range(count)]
        shot.at(0)
        there = [light(shot.at(0), first + apart + seed, pairs, motion) for seed in range(count)]
        paired = [difference(a, b) for a, b in zip(here, there, strict=True)]
        self.dt, self.variances = (np.stack(each) for each in zip(*paired, strict=True))
        values = [np.average([m for _, m in one], axis=0, weights=[n for n, _ in one]) for one in here]
        self.light = np.stack(values)

    @property
    def blocks(self):
        """Blocks of dt, which is taken for 0 where it is not known."""
        return blocks(np.nan_to_num(self.dt))


@pytest.mark.parametrize(
    ("scene", "camera", "moved"),
    [
        pytest.param("diffuse", 0.05, {}, marks=pytest.mark.slow),
        pytest.param("diffuse", 0.0, {"lamp": (0.3, 0, 0), "ball": (-0.1, 0, 0)}, marks=pytest.mark.slow),
        ("glossy", 0.02, {"lamp": (-0.2, 0, 0)}),
    ],
)
def test_the_mean_is_the_difference_of_the_frames(renderer, monkeypatch, scene, camera, moved):
    monkeypatch.setattr("data_gen.frames.time_differences.BATCHES", 2)

    def estimates(**seeds):
        return Estimates(moving(scene, camera, **moved), 16, 16, **seeds)

    paired = estimates()
    assert np.isfinite(paired.dt[0]).all(axis=-1).mean() > 0.85
    what = f"dt of samples in no pairs, {camera} {moved}"
    apart = rendered_once(scene, SIZE, what, lambda: estimates(first=2000, apart=1000).blocks)
    result = z_test(paired.blocks, apart, block=1)
    assert result.passed, str(result)
    if "lamp" in moved:  # It could have failed: the difference is large, and the other sign of it is found out.
        assert not z_test(-paired.blocks, apart, block=1).passed


def test_of_a_camera_at_rest_it_is_that_of_the_pixels(renderer, monkeypatch):
    monkeypatch.setattr("data_gen.frames.time_differences.BATCHES", 2)
    shot = moving("diffuse", lamp=(0.3, 0, 0))

    def light(frame, seed):
        layers = render_stack(shot.at(frame), 64, seed, "gpt-basic", points="independent", unbiased=True).layers
        return blocks(layers["primal"] - layers["direct"])

    def differences():
        later, earlier = (np.stack([light(i, seed) for seed in range(8 * i, 8 * i + 8)]) for i in (1, 0))
        return later - earlier

    of_pixels = rendered_once("diffuse", SIZE, "the lamp moves by 0.3", differences)
    assert z_test(Estimates(shot, 16, 16).blocks, of_pixels, block=1).passed


@pytest.mark.parametrize(
    ("scene", "camera", "moved", "most"),
    [
        ("diffuse", 0.02, {}, 0.05),
        pytest.param("diffuse", 0.0, {"lamp": (0.04, 0, 0)}, 0.05, marks=pytest.mark.slow),
        pytest.param("glossy", 0.02, {}, 0.5, marks=pytest.mark.slow),
        pytest.param("glossy", 0.0, {"gold": (0.03, 0, 0)}, 0.5, marks=pytest.mark.slow),
    ],
)
def test_slow_changes_have_little_noise(renderer, monkeypatch, scene, camera, moved, most):
    monkeypatch.setattr("data_gen.frames.time_differences.BATCHES", 4)
    found = Estimates(moving(scene, camera, **moved), 12, 8)
    noise, of_light = np.nanvar(found.dt, axis=0), np.nanvar(found.light, axis=0)
    # Roots count typical pixels: a few pixels have most of the variance.
    ratio = np.nanmean(np.sqrt(noise)) ** 2 / np.nanmean(np.sqrt(of_light)) ** 2
    assert ratio < most
    assert np.nanmean(found.variances) == pytest.approx(np.nanmean(noise), rel=0.5)


def test_where_nothing_changes_it_is_zero(renderer):
    found = Estimates(moving("diffuse"), 1, 5)
    assert not found.dt.any() and not found.variances.any()


def test_it_is_not_known_where_motion_is_not_or_leads_off_the_film(renderer):
    from data_gen.frames.time_differences import difference, light

    scene = moving("diffuse").at(0)
    motion = np.zeros((*SIZE[::-1], 2))
    motion[3, 4] = np.nan
    motion[5, :2] = -3, 0
    dt, variance = difference(light(scene, 1, 2), light(scene, 1, 2, motion))
    unknown = np.zeros(SIZE[::-1], bool)
    unknown[3, 4] = unknown[5, :2] = True
    assert np.array_equal(np.isnan(dt).any(axis=-1), unknown) and np.array_equal(np.isnan(variance).all(-1), unknown)


def test_batches_count_by_their_samples(rng):
    from data_gen.frames.time_differences import difference

    samples = rng.normal(1, 2, (1000, 5, 1, 1, 3))
    parts = [samples[:, :2].mean(axis=1), samples[:, 2:4].mean(axis=1), samples[:, 4:].mean(axis=1)]
    zero = [(n, np.zeros((1, 1, 3))) for n in (2, 2, 1)]
    found = [difference([(n, part[i]) for n, part in zip((2, 2, 1), parts, strict=True)], zero) for i in range(1000)]
    means, variances = (np.stack(each) for each in zip(*found, strict=True))
    assert np.allclose(means, samples.mean(axis=1), atol=1e-5)
    assert variances.mean() == pytest.approx(4 / 5, rel=0.1) == pytest.approx(means.var(), rel=0.2)
    assert np.isnan(difference(zero[:1], zero[:1])[1]).all()
