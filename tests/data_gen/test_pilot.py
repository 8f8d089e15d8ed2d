"""How ``--sampler auto`` chooses: by the description where that decides, by a pilot where there is time for one."""

import numpy as np
import pytest
from unbiased import load

SHAPE = (32, 48, 3)


def trial(sampler_noise, seconds, error=None, bias=0.0):
    """Of an image that is 1: what a sampler with that relative variance, and that error behind ``wcv``, would show."""
    from data_gen.pilot import Trial

    rng = np.random.default_rng(int(1e6 * (sampler_noise + seconds)))
    primals = tuple(1 + rng.normal(0, sampler_noise**0.5, SHAPE) for _ in range(2))
    images = primals
    if error is not None:
        images = tuple(1 + bias + rng.normal(0, error**0.5, SHAPE) for _ in range(2))
    return Trial(images, primals, seconds)


def test_the_least_time_to_an_error_is_chosen(renderer):
    from data_gen.pilot import judge, times_to_an_error

    trials = {"gpt": trial(0.2, 2.0, error=0.01), "bdpt": trial(0.1, 4.0), "primal": trial(0.2, 1.0)}
    times = times_to_an_error(trials)
    assert times["gpt"] == pytest.approx(0.02, rel=0.3)
    assert times["bdpt"] == pytest.approx(0.4, rel=0.1) and times["primal"] == pytest.approx(0.2, rel=0.1)
    best, why = judge("gpt", times)
    assert best == "gpt" and "times as long by 'bdpt'" in why and "times as long by 'primal'" in why


def test_light_that_a_reconstruction_has_lost_counts(renderer):
    """Both of its images agree: only those of others show what both lack."""
    from data_gen.pilot import judge, times_to_an_error

    trials = {"gpt": trial(0.2, 1.0, error=0.001, bias=-0.7), "bdpt": trial(0.1, 2.0)}
    times = times_to_an_error(trials)
    assert times["gpt"] == pytest.approx(0.49, rel=0.1)
    assert judge("gpt", times)[0] == "bdpt"


def test_an_error_is_no_less_than_what_two_images_differ_by(renderer):
    """Where noise of the others says that there is none, or less than none."""
    from data_gen.pilot import times_to_an_error

    for noise in np.linspace(8, 12, 9):
        trials = {"gpt": trial(noise, 1.0, error=0.01), "primal": trial(noise, 1.0)}
        assert times_to_an_error(trials)["gpt"] > 0.009


def test_photons_are_judged_by_others_and_by_the_time_there_is(renderer):
    """Their blur counts, and falls slower than noise; a witness they are not."""
    from data_gen.pilot import doubtful, judge, times_to_an_error

    others = {"gpt": trial(2.0, 1.0, error=0.5), "primal": trial(1.0, 1.0)}
    trials = others | {"ppm": trial(0.001, 1.0, error=0.001, bias=0.1)}
    short, long = (times_to_an_error(trials, seconds) for seconds in (100.0, 1e6))
    assert judge("gpt", short)[0] == "ppm" and judge("gpt", long)[0] == "gpt"
    # Errors of others fall by 10,000 meanwhile, so it needs 10,000^1.5 times as long in 10,000 times the time.
    assert long["ppm"] / long["gpt"] == pytest.approx(100 * short["ppm"] / short["gpt"])
    # The mean of those who find the light is not sure of it.
    dark = {"gpt": trial(900.0, 1.0, error=0.02), "primal": trial(900.0, 1.0), "ppm": trials["ppm"]}
    assert judge("gpt", times_to_an_error(dark, 100.0))[0] == "gpt" and doubtful(dark) == ["ppm"]
    clear = {"gpt": trial(0.01, 1.0, error=0.001), "primal": trial(0.01, 1.0), "ppm": trials["ppm"]}
    assert doubtful(clear) == [] and doubtful(others) == []


def test_a_choice_needs_a_margin():
    from data_gen.pilot import judge

    assert judge("gpt", {"gpt": 1.0, "bdpt": 0.9})[0] == "gpt"
    assert judge("gpt", {"gpt": 1.0, "bdpt": 0.7})[0] == "bdpt"
    assert "no other" in judge("gpt", {"gpt": 1.0})[1]


def test_candidates_are_those_of_the_registry(renderer):
    from data_gen.pilot import candidates

    names = candidates(load(renderer, "diffuse", (48, 32)))
    assert names[0] == "gpt" and {"bdpt", "primal"} <= set(names)
    assert not {"gpt-basic", "gpt-simple"} & set(names) and len(names) == len(set(names))
    more = candidates(load(renderer, "diffuse", (48, 32)), biased=True)
    assert more[: len(names)] == names and set(more[len(names) :]) == {"ppm", "gpm"}
    assert candidates(load(renderer, "diffuse", (16, 12))) == ["gpt"]
    assert "bdpt" not in candidates(load(renderer, "haze", (48, 32)))


def test_short_renders_are_not_measured(renderer, monkeypatch):
    from data_gen import pilot

    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(pilot, "try_out", None)
    for spp, seconds in ((1000, None), (None, 10.0), (1 << 30, 10.0), (1000, 1000.0)):
        choice = pilot.choose_by_pilot(scene, spp, seconds)
        assert choice.sampler == "gpt" and "too short" in choice.reason and choice.seconds == 0


def test_a_pilot_leaves_the_scene_as_it_was(renderer, monkeypatch):
    from data_gen import pilot
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (48, 32))
    before = render_stack(scene, 2, 0, "gpt")
    monkeypatch.setattr(pilot, "PIXELS", 24 * 16)
    monkeypatch.setattr(pilot, "candidates", lambda scene, biased: ["gpt", "primal"])
    sizes = []
    tried = pilot.try_out
    monkeypatch.setattr(
        pilot, "try_out", lambda scene, *a: (sizes.append(tuple(scene.sensors()[0].film().size())), tried(scene, *a))[1]
    )
    choice = pilot.choose_by_pilot(scene, 1 << 30, 1e6)
    assert choice.sampler in ("gpt", "primal") and choice.reason.startswith("chosen by a pilot: to a given error")
    assert len(sizes) == 2 and {tuple(map(int, size)) for size in sizes} == {(24, 16)}
    after = render_stack(scene, 2, 0, "gpt")
    assert all(np.array_equal(before[name], after[name]) for name in before.names)


def test_the_render_is_that_of_the_sampler_by_name(tmp_path, capsys):
    import ngpt
    from ngpt.cli import main

    files = [tmp_path / "auto.exr", tmp_path / "named.exr"]
    for file, sampler in zip(files, ("auto", "gpt"), strict=True):
        args = ["render", "diffuse", "--size", "16x12", "--spp", "4", "--sampler", sampler, "-o", str(file)]
        assert main(args) == 0
        assert ("sampler 'gpt': " in capsys.readouterr().err) == (sampler == "auto")
    auto, named = map(ngpt.read, files)
    assert auto.attributes["ngpt:sampler"] == "gpt"
    assert all(np.array_equal(auto[name], named[name]) for name in named.names)
