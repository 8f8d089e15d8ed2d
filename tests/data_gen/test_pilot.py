"""How ``--sampler auto`` chooses: by the description where that decides, by a pilot where there is time for one."""

from dataclasses import replace

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

import data_gen
from data_gen.choosing import plans, trials
from data_gen.choosing.pipelines import Pipeline, usual_fall
from data_gen.choosing.plans import best_image, best_of, simple
from data_gen.choosing.trials import Witnesses, candidates
from data_gen.request import RenderRequest
from data_gen.samplers import SAMPLERS, Sampler

SHAPE = (32, 48, 3)


def images(rng, noise, n=4, bias=0.0):
    """Images of a mean of 1, with that relative variance."""
    return [1 + bias + rng.normal(0, noise**0.5, SHAPE) for _ in range(n)]


def witnesses(rng, **noise):
    """Primals of samplers by name, and their relative variances."""
    return Witnesses({name: images(rng, n) for name, n in noise.items()}, noise, np.ones(SHAPE))


def seen(sampler, error, seconds, step=None, **more):
    """What a pilot says of a sampler and its quickest method, at 16 samples."""
    method = "wcv" if SAMPLERS[sampler].gradients else "primal"
    step = usual_fall(sampler, method) if step is None else step
    return Pipeline(sampler, method, 16, error, step, seconds, 0.0, **more)


def test_the_least_error_is_chosen_and_the_others_are_named(renderer):
    pipelines = [seen("gpt", 0.01, 2.0), seen("bdpt", 0.1, 4.0), seen("primal", 0.2, 1.0)]
    best, why = best_of(pipelines, 32.0)
    # 16 samples of gpt; bdpt has 8, primal 32: errors of twice .1 and half of .2
    assert best == "gpt" and "an error of 0.1, and 0.32 by sampler 'primal'" in why and "0.45 by sampler 'bdpt'" in why
    assert best_of(pipelines, 0.5)[0] == "gpt"


def test_errors_that_fall_slowly_lose_in_long_renders(renderer):
    """With the power that a pilot saw, as in scenes whose light paths from the camera hardly find."""
    slow, usual = seen("gpt", 0.07, 1.0, step=-0.55), seen("gpt", 0.07, 1.0)
    # Of batches, which need 16 samples for variances
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
    unsure = [*pipelines[:2], seen("ppm", 0.5, 1.0, doubt=5.0)]
    best, why = best_of(unsure, 100.0)
    assert best == "gpt" and "too little of the light to judge 'ppm'" in why
    image = images(rng, 0.001, 1, 0.1)[0]
    assert witnesses(rng, gpt=900.0, primal=900.0, ppm=1e-3).doubt("ppm", image) > 1
    assert witnesses(rng, gpt=0.01, primal=0.01, ppm=1e-3).doubt("ppm", image) < 0.001


def test_a_choice_needs_a_margin(renderer):
    ours, better, alike = seen("gpt", 0.01, 1.0), seen("gpt-basic", 0.007, 1.0), seen("gpt-basic", 0.0095, 1.0)
    assert best_of([ours, alike], 1000.0)[0] == "gpt" and best_of([ours, better], 1000.0)[0] == "gpt-basic"


def test_candidates_are_those_of_the_registry(renderer):
    """The simple way comes first, and then what finds light that it hardly finds."""
    scene = load(renderer, "diffuse", (48, 32))
    assert candidates(scene) == ["primal", "bdpt"] and candidates(scene, gradients=True) == ["gpt"]
    assert candidates(scene, biased=True) == ["primal", "bdpt", "ppm"]
    assert candidates(load(renderer, "diffuse", (16, 12))) == ["primal"]
    assert candidates(load(renderer, "haze", (48, 32))) == ["primal"]


def test_short_renders_are_not_measured(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(plans, "try_all", None)
    for spp, seconds in ((1000, None), (None, 10.0), (1 << 30, 10.0), (1000, 1000.0)):
        choice = plans.plan_sampler(scene, RenderRequest(scene, spp, seconds=seconds))
        assert choice.sampler == "primal" and "too short" in choice.reason and choice.render == seconds


def test_scenes_are_rendered_the_simple_way(renderer, monkeypatch):
    """Whatever ends the render, unless gradients are asked for, or OIDN is not there."""
    oidn = plans.METHODS["oidn"]
    monkeypatch.setitem(plans.METHODS, "oidn", replace(oidn, missing=lambda: ""))

    def chosen(name, spp=8, **more):
        scene = load(renderer, name, (64, 32))
        plan = plans.plan_sampler(scene, RenderRequest(scene, spp, **more))
        return plan.sampler, plan.method

    assert (simple("primal"), simple("ppm"), simple("gpt-basic")) == ("oidn", "primal", "wcv")
    for scene in ("glossy", "diffuse", "environment", "lens", "haze"):
        assert chosen(scene) == chosen(scene, 1) == ("primal", "oidn")
        assert chosen(scene, gradients=True) == ("gpt", "")
    glossy = load(renderer, "glossy", (64, 32))
    plan = plans.plan(glossy, RenderRequest(glossy, seconds=40.0, method="auto"))
    assert (plan.sampler, plan.method) == ("primal", "oidn") and 35 < plan.render < 40 and "no time" in plan.reason
    assert plans.plan(glossy, RenderRequest(glossy, seconds=5.0, method="wcv")).sampler == "gpt"
    monkeypatch.setitem(plans.METHODS, "oidn", replace(oidn, missing=lambda: "no OIDN"))
    assert chosen("glossy") == ("gpt", "")


@pytest.mark.parametrize("how", [{"adaptive": True}, {"error": 0.5}])
def test_adaptive_samples_are_of_what_the_default_takes(renderer, how):
    """Networks that combine gradients leave grain on the walls of rooms."""
    scene = load(renderer, "glossy", (24, 16))
    stack, plan = data_gen.render_scene(scene, 32, **how)
    assert (plan.sampler, plan.method, plan.shared) == ("primal", "oidn", True)
    assert stack.attributes["ngpt:sampler"] == "primal" and stack.attributes["ngpt:adaptive"] == "oidn"
    assert data_gen.render_scene(scene, 32, method="wcv", **how).plan.sampler == "gpt"


def test_the_simple_way_stays_unless_another_is_clearly_better(renderer):
    """What a pilot expects of images was seen to be wrong by 1.6 times."""
    simple_way = Pipeline("primal", "oidn", 16, 0.01, -0.55, 1.0, 0.0)
    rival = replace(simple_way, sampler="gpt-basic", method="ngpt-combine", error=0.008)
    for ranked, best in (([rival, simple_way], "primal"), ([replace(rival, error=0.004), simple_way], "gpt-basic")):
        assert best_image(ranked, "primal", 16.0).sampler == best
    assert best_image([rival], "primal", 16.0) is rival


def test_a_pilot_leaves_the_scene_as_it_was(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(plans, "PIXELS", 24 * 16)
    monkeypatch.setattr(plans, "candidates", lambda scene, biased, gradients: ["primal", "gpt"])
    choice = plans.plan_sampler(scene, RenderRequest(scene, 1 << 30, seconds=1e6))
    assert choice.sampler in ("gpt", "primal") and choice.reason.startswith("chosen by a pilot: expected to leave")
    assert tuple(scene.sensors()[0].film().size()) == (48, 32)


def test_seeds_of_trials_do_not_depend_on_other_samplers(monkeypatch):
    before = {name: trials.seed_of(name) for name in SAMPLERS}
    seeds = {seed + i for seed in before.values() for i in range(8)}
    assert len(seeds) == 8 * len(before) and max(seeds) < 2**64
    monkeypatch.setattr(trials, "SAMPLERS", {"first": Sampler("first", "of another package", "first"), **SAMPLERS})
    assert {name: trials.seed_of(name) for name in before} == before
