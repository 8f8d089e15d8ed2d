"""How ``--sampler auto`` chooses: by the description where that decides, by a pilot where there is time for one."""

from dataclasses import replace

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.choosing import plans, trials
from data_gen.choosing.pipelines import Pipeline, usual_fall
from data_gen.choosing.plans import best_of, enclosed, judge, simple, times_to_the_end
from data_gen.choosing.trials import Witnesses, candidates
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS, Sampler

SHAPE = (32, 48, 3)


def images(rng, noise, n=4, bias=0.0):
    """Images of a mean of 1, with that relative variance."""
    return [1 + bias + rng.normal(0, noise**0.5, SHAPE) for _ in range(n)]


def witnesses(rng, **noise):
    """Primals of samplers by name, and their relative variances."""
    return Witnesses({name: images(rng, n) for name, n in noise.items()}, noise, np.ones(SHAPE))


def seen(sampler, error, seconds, step=None, **more):
    """What a pilot says of a sampler and its simple method, at 16 samples."""
    method = simple(sampler)
    step = usual_fall(sampler, method) if step is None else step
    return Pipeline(sampler, method, 16, error, step, seconds, 0.0, **more)


def test_the_least_time_to_the_end_is_chosen(renderer):
    pipelines = [seen("gpt", 0.01, 2.0), seen("bdpt", 0.1, 4.0), seen("primal", 0.2, 1.0)]
    times = times_to_the_end(pipelines, 32.0)
    assert times["gpt"] == pytest.approx(32)
    assert times["bdpt"] == pytest.approx(10 * 16 * 4) and times["primal"] == pytest.approx(20 * 16)
    best, why = best_of(pipelines, 32.0)
    assert best == "gpt" and "'bdpt' takes 20 times as long" in why and "'primal' takes 10 times as long" in why


def test_errors_that_fall_slowly_lose_in_long_renders(renderer):
    """With the power that a pilot saw, as in scenes whose light paths from the camera hardly find."""
    slow, usual = seen("gpt", 0.07, 1.0, step=-0.55), seen("gpt", 0.07, 1.0)
    rival = seen("gbdpt", 0.01, 8.0)
    assert best_of([slow, rival], 100.0)[0] == best_of([usual, rival], 100.0)[0] == "gpt"
    assert best_of([slow, rival], 5000.0)[0] == "gbdpt" and best_of([usual, rival], 5000.0)[0] == "gpt"


def test_light_that_a_reconstruction_has_lost_counts(rng):
    """All of its images agree: only those of others, and its own primals, show what they lack."""
    error = witnesses(rng, gpt=0.2, bdpt=0.1).error("gpt", [images(rng, 0.001, 2, -0.7) for _ in range(2)])
    assert error == pytest.approx(0.49, rel=0.1)


def test_an_error_is_no_less_than_what_two_images_differ_by(rng):
    """Where noise of the others says that there is none, or less than none."""
    for noise in np.linspace(8, 12, 9):
        judges = witnesses(rng, gpt=noise, primal=noise)
        assert judges.error("gpt", [images(rng, 0.01, 2) for _ in range(2)]) > 0.009
        assert judges.error("gpt", [images(rng, 0.01, 1) for _ in range(2)]) > 0.009


def test_no_photons_are_witnesses(rng):
    """However little noise they have: they blur."""
    primals = {"gpt": images(rng, 0.1), "ppm": images(rng, 1e-6, bias=0.5)}
    judges = Witnesses(primals, {"gpt": 0.1, "ppm": 1e-6}, np.ones(SHAPE))
    assert judges.error("gpt", [images(rng, 0.01, 2) for _ in range(2)]) == pytest.approx(0.01, rel=0.5)
    assert judges.error("ppm", [primals["ppm"][:2], primals["ppm"][2:]]) == pytest.approx(0.25, rel=0.2)


def test_photons_are_judged_by_others_and_by_the_time_there_is(renderer, rng):
    """Their errors fall slower than noise, and where others hardly find the light nobody is sure of them."""
    pipelines = [seen("gpt", 0.5, 1.0), seen("primal", 1.0, 1.0), seen("ppm", 0.01, 1.0, doubt=0.002)]
    assert best_of(pipelines, 100.0)[0] == "ppm" and best_of(pipelines, 1e7)[0] == "gpt"
    times = times_to_the_end([seen("primal", 1.0, 1.0), seen("ppm", 0.01, 1.0)], 16e3)
    assert times["primal"] == pytest.approx(16e3) and times["ppm"] == pytest.approx(16 * (0.001 / 0.01) ** -1.5)
    unsure = [*pipelines[:2], seen("ppm", 0.5, 1.0, doubt=5.0)]
    best, why = best_of(unsure, 100.0)
    assert best == "gpt" and "too little of the light to judge 'ppm'" in why
    image = images(rng, 0.001, 1, 0.1)[0]
    assert witnesses(rng, gpt=900.0, primal=900.0, ppm=1e-3).doubt("ppm", image) > 1
    assert witnesses(rng, gpt=0.01, primal=0.01, ppm=1e-3).doubt("ppm", image) < 0.001


def test_a_choice_needs_a_margin():
    assert judge("gpt", {"gpt": 1.0, "bdpt": 0.95})[0] == "gpt"
    assert judge("gpt", {"gpt": 1.0, "bdpt": 0.7})[0] == "bdpt"
    assert "no time to try others" in judge("gpt", {"gpt": 1.0})[1]


def test_candidates_are_those_of_the_registry(renderer):
    names = candidates(load(renderer, "diffuse", (48, 32)))
    assert names[0] == "gpt" and {"bdpt", "primal"} <= set(names)
    assert not {"gpt-basic", "gpt-simple"} & set(names) and len(names) == len(set(names))
    more = candidates(load(renderer, "diffuse", (48, 32)), biased=True)
    assert more[: len(names)] == names and more[len(names) :] == ["ppm"]
    assert candidates(load(renderer, "diffuse", (16, 12))) == ["gpt"]
    assert "bdpt" not in candidates(load(renderer, "haze", (48, 32)))


def test_short_renders_are_not_measured(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(plans, "try_all", None)
    for spp, seconds in ((1000, None), (None, 10.0), (1 << 30, 10.0), (1000, 1000.0)):
        choice = plans.plan_sampler(scene, spp, seconds)
        assert choice.sampler == "gpt" and "too short" in choice.reason and choice.render == seconds


@pytest.mark.parametrize("walls", [1, -1])
def test_a_room_is_one_whichever_way_its_walls_face(renderer, walls):
    """And a floor beneath the open sky is none."""
    to = renderer.ScalarTransform4f()
    camera = {"type": "perspective", "fov": 60, "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    camera["to_world"] = to.look_at([0, 0, 0.5], [0.3, -0.4, 0], [0, 1, 0])
    room = {"type": "cube", "flip_normals": walls < 0}
    floor = {"type": "rectangle", "to_world": to.translate([0, -1, 0]).scale(9).rotate([1, 0, 0], -90 * walls)}
    assert enclosed(renderer.load_dict({"type": "scene", "camera": camera, "room": room}))
    assert not enclosed(renderer.load_dict({"type": "scene", "camera": camera, "floor": floor}))


def test_rooms_are_rendered_without_gradients(renderer, monkeypatch):
    """Where the renders have paths enough to share, nothing asks for gradients, and OIDN is there."""

    def chosen(name, size, spp, **more):
        plan = plans.plan_sampler(load(renderer, name, size), spp, None, **more)
        return plan.sampler, plan.method

    room = ("primal", "ngpt-primal")
    monkeypatch.setitem(plans.METHODS, "ngpt-primal", replace(plans.METHODS["ngpt-primal"], missing=lambda: ""))
    assert chosen("glossy", (128, 64), 8) == room
    assert chosen("glossy", (256, 256), 1) == ("primal", "")
    assert chosen("glossy", (128, 64), 2) == chosen("glossy", (128, 64), 8, gradients=True) == ("gpt", "")
    for open_scene in ("diffuse", "environment", "lens", "haze"):
        assert chosen(open_scene, (128, 64), 8) == ("gpt", "")
    plan = plans.plan(load(renderer, "glossy", (128, 64)), 5.0)
    assert (plan.sampler, plan.method) == room and 0 < plan.render < 5
    assert plans.plan(load(renderer, "glossy", (128, 64)), 5.0, "wcv").sampler == "gpt"
    monkeypatch.setitem(plans.METHODS, "ngpt-primal", replace(plans.METHODS["ngpt-primal"], missing=lambda: "no OIDN"))
    assert chosen("glossy", (128, 64), 8) == ("gpt", "")


def test_every_camera_is_asked_whether_it_is_in_a_room(renderer):
    """Cameras that fill a surface have ray differentials only."""
    from camera_cases import RENDERED, scene_with

    assert [view for view in (*RENDERED, "batch") if enclosed(scene_with(renderer, view)) not in (True, False)] == []


def test_a_pilot_leaves_the_scene_as_it_was(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    before = render_stack(scene, 2, 0, "gpt")
    monkeypatch.setattr(plans, "PIXELS", 24 * 16)
    monkeypatch.setattr(plans, "candidates", lambda scene, biased: ["gpt", "primal"])
    choice = plans.plan_sampler(scene, 1 << 30, 1e6)
    assert choice.sampler in ("gpt", "primal") and choice.reason.startswith("chosen by a pilot: to the same error")
    after = render_stack(scene, 2, 0, "gpt")
    assert all(np.array_equal(before[name], after[name]) for name in before.names)


def test_seeds_of_trials_do_not_depend_on_other_samplers(monkeypatch):
    before = {name: trials.seed_of(name) for name in SAMPLERS}
    seeds = {seed + i for seed in before.values() for i in range(8)}
    assert len(seeds) == 8 * len(before) and max(seeds) < 2**64
    monkeypatch.setattr(trials, "SAMPLERS", {"first": Sampler("first", "of another package", "first"), **SAMPLERS})
    assert {name: trials.seed_of(name) for name in before} == before
