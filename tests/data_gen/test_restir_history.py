"""Reservoirs over frames of a camera that moves: unbiased after three frames, and the better for them."""

from functools import cache

import numpy as np
import pytest
from restir_shots import CHAINS, FRAMES, SIZE, layers_of, noise_left, rendered_by_gpt
from unbiased import load

from data_gen.samplers.restir.footprint import pair_motions
from data_gen.samplers.restir.reservoir import confidence_after
from ngpt.testing import z_test

STEPS = ((0, 0), (1, 0), (0, 1))


class Room:
    """A scene, and a camera that turns and goes sideways from frame to frame: by 1.6 pixels."""

    def __init__(self, mi, name, step=0.12):
        from data_gen.paths.walk import Limits
        from data_gen.samplers.gpt.plan import make_plan
        from data_gen.scenes import builtin

        description = getattr(builtin, name)()
        description["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        self.mi, self.step, self.scene = mi, step, load(mi, description)
        depths = {key: description["integrator"].get(key, 5) for key in ("max_depth", "rr_depth")}
        self.plan = make_plan(self.scene, Limits(**depths), caustic=False)
        self.sensor = self.scene.sensors()[0]
        self.start = np.array(mi.traverse(self.sensor)["to_world"].matrix, np.float64).reshape(4, 4, -1)[..., 0]

    def at(self, frame):
        """Moves the camera; returns what motion and pairs need of it."""
        from data_gen.frames.motion import snapshot

        angle = np.radians(1.0 * frame)
        turn = np.eye(4)
        turn[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
        matrix = self.start @ turn
        matrix[:3, 3] -= self.start[:3, 0] * self.step * frame
        params = self.mi.traverse(self.sensor)
        params["to_world"] = self.mi.Transform4f(self.mi.ScalarTransform4f(matrix).matrix)
        params.update()
        return snapshot(self.scene)

    def frames(self, seed=5, chains=CHAINS, count=FRAMES, **options):
        """History, and for each frame its values, (chains, H, W, 3)."""
        from data_gen.frames.motion import motion_vectors
        from data_gen.samplers.restir.history import History
        from data_gen.samplers.restir.stage import Stage

        history = History(Stage(self.scene, self.plan, self.sensor), seed, chains, **options)
        before = None
        for frame in range(count):
            now = self.at(frame)
            # Shapes do not move, and are not looked at.
            now = type(now)(() if before is None else before.shapes, now.film, now.place)
            motion = None if before is None else motion_vectors(self.scene, now, before)
            values, before = history.next_frame(motion), now
            yield history, layers_of(values, chains)


@pytest.fixture(scope="module")
def rooms(renderer):
    return {name: Room(renderer, name) for name in ("diffuse", "glossy")}


@pytest.fixture(scope="module")
def references(rooms):
    """(scene, frame) -> layers of independent renders of gpt, (renders, H, W, 3)."""

    @cache
    def rendered(name, frame):
        rooms[name].at(frame)
        return rendered_by_gpt(rooms[name].scene)

    return rendered


@pytest.fixture(scope="module")
def shots(rooms):
    """Scene -> the values of all frames."""
    return cache(lambda name: [values for _, values in rooms[name].frames()])


SCENES = ["diffuse", pytest.param("glossy", marks=pytest.mark.slow)]


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", ["path", "primal", "dx", "dy"])
def test_the_third_frame_of_a_moving_camera_is_unbiased(shots, references, scene, name):
    result = z_test(shots(scene)[-1][name], references(scene, FRAMES - 1)[name])
    assert result.passed, result


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", ["primal", "dx", "dy"])
def test_history_is_worth_it(shots, scene, name):
    assert noise_left(shots(scene), name) < 0.75


def test_differences_end_at_the_film(shots):
    assert not shots("diffuse")[-1]["dx"][:, :, -1].any()
    assert not shots("diffuse")[-1]["dy"][:, -1].any()


def test_candidates_are_new_in_every_frame(rooms, monkeypatch):
    room = rooms["diffuse"]
    at = room.at
    monkeypatch.setattr(room, "at", lambda frame: at(0))
    frames = [values for _, values in room.frames(chains=2, count=2)]
    assert not np.array_equal(frames[0]["path"], frames[1]["path"])


def test_the_same_seed_gives_the_same_frames(rooms):
    runs = [[values for _, values in rooms["diffuse"].frames(chains=2, count=2)] for _ in range(2)]
    for name in ("primal", "dx", "dy"):
        assert np.array_equal(runs[0][-1][name], runs[1][-1][name])


@pytest.mark.slow
def test_differences_after_reuse_are_unbiased(rooms, references):
    """The baseline: no reservoirs of pairs."""
    *_, (_, last) = rooms["diffuse"].frames(pairs=False)
    for name in ("primal", "dx", "dy"):
        result = z_test(last[name], references("diffuse", FRAMES - 1)[name])
        assert result.passed, (name, result)


def all_kept(history):
    """What every reservoir of the next frame would find, and the lanes it is about."""
    import drjit as dr
    import mitsuba as mi

    lane = dr.arange(mi.UInt32, 4 * history.at.total)
    it = history.at.corner(lane, history.kept)
    dr.eval(it)
    return lane, it


def test_each_path_is_looked_for_where_it_was_kept(rooms):
    """What could have found a path is the same from both sides: then the MIS weights of its finders sum to 1."""
    *_, (history, _) = rooms["diffuse"].frames(chains=2, count=2)
    lane, it = all_kept(history)
    good, twice = np.array(it.good), np.array(it.twice)
    pixel = history.at.pixel(lane // 4 % history.at.n)

    def found(wrapped):
        mode = rooms["diffuse"].mi.Bool(wrapped)
        place, before, there = history.at.before(it.domain, pixel, it.side, it.place, mode)
        return np.array(place), np.array(before), np.broadcast_to(np.array(there), good.shape)

    was = np.array(history.kept.record.place)[:, np.array(it.source)]
    mine, other = (was, np.array(it.before)), (np.array(it.elsewhere), np.array(it.other))
    straight, wrapped = found(False), found(True)
    first = (straight[1] == mine[1]).all(axis=0)
    for place, pair in (mine, other):
        known = good & (twice if place is other[0] else True)
        from_here = np.where((straight[1] == pair).all(axis=0), straight[0], wrapped[0])
        exists = (straight[1] == pair).all(axis=0) | ((wrapped[1] == pair).all(axis=0) & wrapped[2])
        assert exists[known].mean() > 0.9999
        assert np.abs(from_here - place)[:, known & exists].max() < 1e-4
    # One way or two, the same from both sides
    assert (wrapped[2] == twice)[good].mean() > 0.9999
    assert 0.2 < first[good].mean() < 0.95


@pytest.mark.parametrize("scene", SCENES)
def test_shifted_to_this_frame_and_back_is_what_was_kept(rooms, scene):
    """r(T x) r(x) = 1: the same light, and Jacobians whose product is 1; and most of what was kept is still there."""
    import drjit as dr
    import mitsuba as mi

    from data_gen.samplers.restir.evaluate import evaluate_record
    from data_gen.samplers.restir.record import gather

    room = rooms[scene]
    runs = room.frames(chains=2, count=2)
    next(runs)
    history, _ = next(runs)
    _, it = all_kept(history)
    # The camera of the frame to come
    room.at(FRAMES - 1)
    shift = (history.stage, history.seed)
    record = gather(history.kept.record, it.source)
    here = evaluate_record(*shift, record, it.place, it.good)
    dr.eval(here)
    good = np.array(it.good) & np.array(here.f).any(axis=0)
    primal = np.array(it.domain) == 0
    assert good[primal].sum() > 0.6 * np.array(it.good)[primal].sum() > 500
    with history.pose.of(room.sensor):
        moved = record.moved(it.place, here.geometry)
        back = evaluate_record(*shift, moved, record.place, mi.Bool(True))
        own = evaluate_record(*shift, record, record.place, mi.Bool(True))
        dr.eval(back, own)
    f, expected = np.array(back.f)[:, good], np.array(own.f)[:, good]
    assert np.mean(np.abs(f - expected).max(axis=0) < 1e-3 * expected.max(axis=0) + 1e-12) > 0.995
    assert np.mean(np.abs(np.array(here.J)[good] * np.array(back.J)[good] - 1) < 1e-3) > 0.995
    # In its own pixel, by the camera of its own frame, a path is worth what is stored.
    value = np.array(history.kept.value)[:, np.array(it.source)][:, good & primal]
    own = np.array(own.f)[:, good & primal]
    assert np.mean(np.abs(own - value).max(axis=0) < 1e-3 * value.max(axis=0) + 1e-12) > 0.995


def test_a_camera_in_another_pose_comes_back(rooms):
    from data_gen.samplers.restir.pose import Pose

    room = rooms["diffuse"]

    def where():
        return np.array(room.mi.traverse(room.sensor)["to_world"].matrix).ravel()

    room.at(0)
    first, pose = where(), Pose(room.sensor)
    room.at(2)
    last = where()
    with pytest.raises(ValueError, match="amid"), pose.of(room.sensor):
        assert np.array_equal(where(), first)
        raise ValueError("amid")
    assert np.array_equal(where(), last)
    assert not np.array_equal(first, last)


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
    assert not still[1, :, -1].any()
    assert not still[2, -1].any()
    assert (confidence_after(before, motion * np.nan, STEPS, 32)[0] == 1).all()


def test_a_pair_moves_as_its_nearer_pixel_does(rng):
    motion, depth = rng.normal(size=(4, 6, 2)), rng.uniform(size=(4, 6))
    primal, dx, dy = pair_motions(motion, depth, STEPS)
    assert np.array_equal(primal, motion)
    nearer = depth[:, 1:] < depth[:, :-1]
    assert np.array_equal(dx[:, :-1], np.where(nearer[..., None], motion[:, 1:], motion[:, :-1]))
    assert np.isnan(dx[:, -1]).all()
    assert np.isnan(dy[-1]).all()


# ------------------------------ Mutants ------------------------------


def far_differences(room, monkeypatch):
    """Differences of pixels far from each other: their shifts have Jacobians far from 1."""
    from data_gen.samplers.restir import history, layout, merging

    right = layout.step
    with monkeypatch.context() as patch:
        for where in (history, layout, merging):
            patch.setattr(where, "step", lambda domain: 8 * right(domain))
        found = [next(iter(room.frames(seed, count=1)))[1]["dx"] for seed in range(2)]
    return np.concatenate(found)[:, :, :-8]


def far_references(references):
    primal = references("diffuse", 0)["primal"]
    return primal[:, :, 8:] - primal[:, :, :-8]


def test_differences_of_far_pixels_are_unbiased(rooms, references, monkeypatch):
    result = z_test(far_differences(rooms["diffuse"], monkeypatch), far_references(references))
    assert result.passed, result
