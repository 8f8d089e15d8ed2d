"""Reservoirs over frames of a camera that stands still: unbiased after three frames, and the better for them."""

import numpy as np
import pytest

from ngpt.testing import z_test

SIZE, CHAINS, FRAMES = 24, 48, 3


@pytest.fixture(scope="module")
def room(renderer):
    from data_gen.samplers.gpt.plan import make_plan
    from data_gen.scenes import builtin

    description = builtin.diffuse()
    description["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    scene = renderer.load_dict(description)
    depths = {key: description["integrator"].get(key, 5) for key in ("max_depth", "rr_depth")}
    plan = make_plan(scene, 0.05, **depths, shift="replay", hide_emitters=False, caustic=False)
    return scene, plan, scene.sensors()[0]


@pytest.fixture(scope="module")
def references(room):
    """Layers of independent renders of gpt, (renders, H, W, 3)."""
    from data_gen.render import render_stack

    stacks = [render_stack(room[0], 48, seed, "gpt", caustic=False).layers for seed in range(900, 910)]
    layers = {name: np.stack([stack[name] for stack in stacks]) for name in ("primal", "direct", "dx", "dy")}
    layers["primal"] = layers["path"] = layers["primal"] - layers.pop("direct")
    return layers


def history(room, seed=5, chains=CHAINS, cap=32):
    from data_gen.samplers.restir.history import History

    return History(*room, seed, chains, cap)


def images(values, chains=CHAINS):
    """(chains, H, W, 3) of a value of each lane."""
    return np.moveaxis(np.array(values, np.float64).T.reshape(SIZE, SIZE, chains, 3), 2, 0)


@pytest.fixture(scope="module")
def frames(room):
    chains = history(room)
    return [{name: images(value) for name, value in chains.next_frame().items()} for _ in range(FRAMES)]


@pytest.mark.parametrize("name", ["path", "primal", "dx", "dy"])
def test_the_third_frame_is_unbiased(frames, references, name):
    result = z_test(frames[-1][name], references[name])
    assert result.passed, result


@pytest.mark.parametrize("name", ["primal", "dx", "dy"])
def test_three_frames_are_better_than_one(frames, name):
    first, last = (frame[name].var(axis=0).mean() for frame in (frames[0], frames[-1]))
    assert last < 0.6 * first


def test_candidates_are_new_in_every_frame(frames):
    assert not np.array_equal(frames[0]["path"], frames[1]["path"])


def test_differences_end_at_the_film(frames):
    assert not frames[-1]["dx"][:, :, -1].any()
    assert not frames[-1]["dy"][:, -1].any()


def test_the_same_seed_gives_the_same_frames(room, frames):
    again = images(history(room).next_frame()["dx"])
    assert np.array_equal(again, frames[0]["dx"])


def test_confidence_is_capped(room):
    """With a cap below two frames a chain still forgets, and its reservoirs never count for more."""
    chains = history(room, chains=2, cap=1.5)
    for _ in range(2):
        chains.next_frame()
    assert all((np.array(kept.M) == 1.5).all() for kept in chains.kept.values())


def far_differences(room, toward=(8, 0), seeds=range(2)):
    """Differences of pixels far from each other: their shifts have Jacobians far from 1."""
    import drjit as dr
    import mitsuba as mi

    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers.restir.walk import choices, walk

    estimates = []
    for seed in seeds:
        chains = history(room, seed)
        camera = CameraSamples(chains.sensor, seed, CHAINS)
        sample = dr.arange(mi.UInt32, dr.width(camera.pixel)) % dr.opaque(mi.UInt32, CHAINS)
        choice = choices(seed, camera, sample)
        found = walk(chains.scene, chains.plan, camera, sample, choice)
        positive, negative = chains.pair(camera, found, toward, choice)
        estimates.append(images(positive.estimate() - negative.estimate()))
    return np.concatenate(estimates)[:, :, : -toward[0]]


def far_references(references):
    return references["primal"][:, :, 8:] - references["primal"][:, :, :-8]


def test_differences_of_far_pixels_are_unbiased(room, references):
    result = z_test(far_differences(room), far_references(references))
    assert result.passed, result


def without_jacobian(monkeypatch):
    from data_gen.samplers.restir import history as module

    right = module.evaluate_at

    def wrong(*args):
        shifted = right(*args)
        shifted.J = type(shifted.J)(1)
        return shifted

    monkeypatch.setattr(module, "evaluate_at", wrong)


def with_half_weights(monkeypatch):
    from data_gen.samplers.restir import history as module

    monkeypatch.setattr(module, "difference", lambda first, second, side: (second - first) / 2)


def with_wrong_side(monkeypatch):
    from data_gen.samplers.restir import history as module

    right = module.difference
    monkeypatch.setattr(module, "difference", lambda first, second, side: right(first, second, 1 - side))


@pytest.mark.parametrize("mutant", [without_jacobian, with_half_weights, with_wrong_side])
def test_a_wrong_rule_is_seen_by_that(room, references, monkeypatch, mutant):
    mutant(monkeypatch)
    assert not z_test(far_differences(room), far_references(references)).passed
