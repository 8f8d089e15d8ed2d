"""Reservoirs over frames in which the camera, things or lamps move: unbiased after three, and the better for them."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from restir_shots import FRAMES, Room, close, inverse, lamp, rendered_by_gpt, things

from ngpt.testing import z_test
from ngpt_studies.restir.evaluate import evaluate_record
from ngpt_studies.restir.record import gather
from ngpt_studies.restir.reservoir import confidence_after, pair_motions
from ngpt_studies.restir.stage import Pose

STEPS = ((0, 0), (1, 0), (0, 1))
MORE = [("diffuse", None), ("diffuse", things), ("glossy", None), ("glossy", lamp)]
SHOTS = [("diffuse", lamp), *(pytest.param(shot, marks=pytest.mark.slow) for shot in MORE)]


@pytest.fixture(scope="module")
def rooms(renderer):
    return cache(Room)


@pytest.fixture(scope="module")
def references(rooms):
    """(scene, change, frame) -> layers of independent renders of gpt, (renders, H, W, 3)."""
    return cache(lambda name, change, frame: rendered_by_gpt(rooms(name, change).at(frame)[0].scene))


@pytest.fixture(scope="module")
def shots(rooms):
    return cache(lambda name, change: [layers for _, layers in rooms(name, change).frames()])


@pytest.mark.parametrize("shot", SHOTS)
@pytest.mark.parametrize("name", ["path", "primal", "dx", "dy"])
def test_the_third_frame_is_unbiased(shots, references, shot, name):
    result = z_test(shots(*shot)[-1][name], references(*shot, FRAMES - 1)[name])
    assert result.passed, result


@pytest.mark.parametrize("shot", SHOTS)
@pytest.mark.parametrize("name", ["primal", "dx", "dy"])
def test_history_is_worth_it(shots, shot, name):
    """The variance of the last frame over the variance of the first, each relative to its candidates."""
    variances, paths = (
        [np.sort(frame[layer].var(axis=0).mean(axis=-1).ravel())[:-10].mean() for frame in shots(*shot)]
        for layer in (name, "path")
    )
    assert variances[-1] / paths[-1] / (variances[0] / paths[0]) < (0.8 if shot[1] else 0.75)


def test_differences_end_at_the_film(shots):
    last = shots("diffuse", lamp)[-1]
    assert not last["dx"][:, :, -1].any() and not last["dy"][:, -1].any()


def test_candidates_are_new_in_every_frame_and_the_same_for_a_seed(rooms):
    first, second = ([layers for _, layers in rooms("diffuse", None).frames(chains=2, count=2)] for _ in range(2))
    for name in ("primal", "dx", "dy"):
        assert np.array_equal(first[-1][name], second[-1][name])
    still = Room("diffuse")
    still.turn = still.step = 0
    frames = [layers["path"] for _, layers in still.frames(chains=2, count=2)]
    assert not np.array_equal(*frames)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["primal", "dx", "dy"])
def test_differences_after_reuse_are_unbiased(rooms, references, name):
    """The baseline: no reservoirs of pairs."""
    *_, (_, last) = rooms("diffuse", None).frames(pairs=False)
    result = z_test(last[name], references("diffuse", None, FRAMES - 1)[name])
    assert result.passed, result


def all_kept(history):
    """What every reservoir of the next frame would find, and the lanes it is about."""
    lane = dr.arange(mi.UInt32, 4 * history.at.total)
    it = history.at.corner(lane, history.kept)
    dr.eval(it)
    return lane, it


@pytest.mark.parametrize("scene", ["diffuse", pytest.param("glossy", marks=pytest.mark.slow)])
def test_shifted_to_this_frame_and_back_is_what_was_kept(rooms, scene):
    """r(T x) r(x) = 1: the same light, and Jacobians whose product is 1; and most of what was kept is still there."""
    room = rooms(scene, None)
    *_, (history, _) = room.frames(chains=2, count=2)
    _, it = all_kept(history)
    room.at(FRAMES - 1)
    shift = (history.stage, history.seed)
    record = gather(history.kept.record, it.source)
    here = evaluate_record(*shift, record, it.place, it.good)
    dr.eval(here)
    good = np.array(it.good) & np.array(here.f).any(axis=0)
    primal = np.array(it.domain) == 0
    assert good[primal].sum() > 0.6 * np.array(it.good)[primal].sum() > 500
    with history.pose.of(room.sensor):
        back = evaluate_record(*shift, record.moved(it.place, here.geometry), record.place, mi.Bool(True))
        own = evaluate_record(*shift, record, record.place, mi.Bool(True))
        dr.eval(back, own)
    assert close(np.array(back.f)[:, good], np.array(own.f)[:, good]) > 0.995
    assert inverse(np.array(here.J)[good], np.array(back.J)[good]) > 0.995
    # In its own pixel, by the camera of its own frame, a path is worth what is stored.
    value = np.array(history.kept.value)[:, np.array(it.source)]
    assert close(np.array(own.f)[:, good & primal], value[:, good & primal]) > 0.995


def test_a_camera_in_another_pose_comes_back(rooms):
    room = rooms("diffuse", None)

    def where():
        return np.array(mi.traverse(room.sensor)["to_world"].matrix).ravel()

    room.at(0)
    first, pose = where(), Pose(room.sensor)
    room.at(2)
    last = where()
    with pytest.raises(ValueError, match="amid"), pose.of(room.sensor):
        assert np.array_equal(where(), first)
        raise ValueError("amid")
    assert np.array_equal(where(), last) and not np.array_equal(first, last)


# ------------------------------ Footprints ------------------------------


def test_confidence_grows_by_areas_to_its_cap():
    motion = np.zeros((3, 4, 6, 2))
    still = confidence_after(np.ones((3, 4, 6)), motion, STEPS, 32)
    assert (still[0] == 2).all()
    assert (confidence_after(np.full((3, 4, 6), 31.5), motion, STEPS, 32)[0] == 32).all()
    before = np.ones((3, 4, 6)) * np.arange(6)
    moved = confidence_after(before, motion + np.array([0.25, 0]), STEPS, 32)
    assert np.allclose(moved[0, 1, :5], 1 + 0.75 * np.arange(5) + 0.25 * np.arange(1, 6))
    # Beyond the film there is none, nor of pairs that reach over its edge.
    assert np.allclose(moved[0, 1, 5], 1 + 0.75 * 5)
    assert not still[1, :, -1].any() and not still[2, -1].any()
    assert (confidence_after(before, motion * np.nan, STEPS, 32)[0] == 1).all()


def test_a_pair_moves_as_its_nearer_pixel_does(rng):
    motion, depth = rng.normal(size=(4, 6, 2)), rng.uniform(size=(4, 6))
    primal, dx, dy = pair_motions(motion, depth, STEPS)
    assert np.array_equal(primal, motion)
    nearer = depth[:, 1:] < depth[:, :-1]
    assert np.array_equal(dx[:, :-1], np.where(nearer[..., None], motion[:, 1:], motion[:, :-1]))
    assert np.isnan(dx[:, -1]).all() and np.isnan(dy[-1]).all()
