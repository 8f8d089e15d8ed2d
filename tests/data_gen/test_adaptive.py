"""Samples shared out by the error of the result: ``ngpt render --adaptive`` and ``--error``."""

import json
import time
from itertools import count

import numpy as np
import pytest
from references import references
from unbiased import load, same

import ngpt
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
from ngpt.subpixels import means

pytest.importorskip("mitsuba")

from data_gen import adaptive, passes
from data_gen.adaptive import Adaptive, Assessment, assess, share_out
from data_gen.choosing import plans
from data_gen.render import render_stack
from data_gen.samplers.reused import Made

SIZE = (32, 32)


@pytest.fixture(scope="module")
def rendered(renderer):
    """Renders a built-in scene; the kernels of each scene are recorded once."""
    scenes, made = {}, {}

    def render(scene, *arguments, **options):
        if scene not in scenes:
            scenes[scene], made[scene] = load(renderer, scene, SIZE), Made()
        return render_stack(scenes[scene], *arguments, unbiased=True, made=made[scene], **options)

    return render


@pytest.fixture
def render(rendered):
    def render(spp, seed=0, scene="glossy", sampler="gpt", error=None, method="wcv", **options):
        return rendered(scene, spp, seed, sampler, adaptive=Adaptive(error, method), **options)

    return render


def halves(mi, scene):
    """Two converged images of a built-in scene."""
    images = references(mi, scene, SIZE)
    return images[::2].mean(axis=0), images[1::2].mean(axis=0)


def test_counts_are_proportional_to_what_is_needed(renderer, rng):
    need, n = rng.lognormal(size=5000), np.full(5000, 16)
    after = n + 16 * share_out(need, n, 5000 * 1600)
    assert after.sum() == pytest.approx(5000 * 1616, rel=0.01)
    share = need / need.mean()
    # No less than a quarter of the even share, no more than 16 times that; in whole blocks.
    share = np.clip(share, 0.25, 16)
    assert np.abs(after - after.mean() * share / share.mean()).max() < 16
    # What has more than its share keeps it, and others get the rest.
    n = np.where(np.arange(5000) < 100, 16000, 16)
    more = share_out(np.ones(5000), n, 5000 * 160)
    assert not more[:100].any() and 16 * more.sum() == pytest.approx(5000 * 160, rel=0.1)
    assert share_out(np.zeros(5000), n, 16).sum() > 0  # a step is never empty


def test_the_mean_number_is_kept_and_passes_are_not_seen(render, monkeypatch):
    stack = render(40, 3)
    samples = stack["samples"]
    assert samples.mean() == 40 and samples.min() == 16 and samples.max() > 60
    assert stack.attributes["ngpt:spp"] == 40 and stack.attributes["ngpt:adaptive"] == "wcv"
    calls = []
    monkeypatch.setattr(passes, "FIRST_LANES", 16 * 100)
    monkeypatch.setattr(passes, "PASS_SECONDS", 0.3)
    same(stack, render(40, 3, progress=lambda *call: calls.append(call)))
    assert calls[0] == (0, 40) and calls[-1] == (40, 40) and len(calls) > 5
    assert render(1 << 20, 3, stop=lambda: True).attributes["ngpt:spp"] == 16


def test_time_is_kept(render, monkeypatch):
    """The clock advances with each look at it, however busy the machine is."""
    looks = count()
    monkeypatch.setattr(time, "perf_counter", lambda: 0.05 * next(looks))
    stack = render(None, 3, "diffuse", seconds=2.0)
    assert 1.0 < 0.05 * next(looks) < 2.5
    assert stack.attributes["ngpt:spp"] >= 16


def test_a_firefly_gets_no_samples_for_all_around_it(renderer, rng):
    """A pixel whose noise is a thousand times that of others is one pixel, and left out of the error of all."""
    primal = rng.uniform(0.5, 1.0, (48, 48, 3)).astype(np.float32)
    variance = np.full_like(primal, 1e-4)
    calm = assess(GradientStack({"primal": primal, "primal_var": variance}), "primal")
    variance[20, 20] = 100.0
    wild = assess(GradientStack({"primal": primal, "primal_var": variance}), "primal")
    assert wild.error == pytest.approx(calm.error, rel=0.1)
    assert np.all(wild.relative < 1.5 * calm.relative)


def test_what_a_choice_takes_is_known_ahead(render, monkeypatch):
    """A method that takes long for its pixels is not begun where it would end too late. Subpixels count too."""
    parts = []

    def slow(stack, method):
        parts.append(stack)
        return Assessment(np.ones(stack.width * stack.height), 1.0, method)

    monkeypatch.setattr(adaptive, "assess", slow)
    monkeypatch.setattr(adaptive, "_PART", 40)
    # A clock on which all takes long: nothing is begun when time is over.
    clock = count()
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    stack = render(None, 0, "diffuse", "primal", method="primal", seconds=0.1)
    assert not parts and stack.attributes["ngpt:spp"] == 16
    # And one on which the method takes 20 us a pixel
    monkeypatch.setattr(time, "perf_counter", lambda: 2e-5 * sum(part.width * part.height for part in parts))
    y, x = np.mgrid[:160, :200].astype(np.float32)
    fine = {"primal": np.repeat((1000 * y + x)[..., None], 3, axis=-1)}
    stack = GradientStack({"primal": means(fine["primal"], 2)}, fine=fine)
    assert adaptive.seconds_to_assess(stack, "oidn") == pytest.approx(0.16)
    assert [part.fine["primal"].shape for part in parts] == [(20, 20, 3), (80, 80, 3)]
    assert all(np.array_equal(means(part.fine["primal"], 2), part["primal"]) for part in parts)
    assert adaptive.seconds_to_assess(GradientStack({"primal": stack["primal"][:79, :80]}), "primal") == 0.0


def test_samples_go_where_the_error_is(rendered, render, renderer):
    """The same number makes a better image, by the method they were meant for."""
    expected, errors = halves(renderer, "glossy"), []
    for seed in range(3):
        stacks = rendered("glossy", 96, seed, "gpt"), render(96, seed)
        errors.append([relmse_trimmed(reconstruct(stack, "wcv").image, *expected) for stack in stacks])
    even, adaptive = np.mean(errors, axis=0)
    assert adaptive < 0.95 * even


@pytest.mark.slow
def test_samples_that_choose_hardly_bias_the_mean(rendered, render, monkeypatch):
    """They stay in the means: were each pixel judged by its own noise alone, the image would be too dark."""

    def by_pixel(stack, method):
        return adaptive.Assessment(np.sqrt(stack["primal_var"].sum(axis=-1)).ravel(), 1.0, method)

    light = rendered("glossy", 8192, 99, "primal", with_features=False)["primal"].mean()

    def bias():
        """In the mean over renders, and its standard error."""
        how = {"sampler": "primal", "method": "primal", "with_features": False}
        each = np.array([render(32, seed, **how)["primal"].mean() for seed in range(10)]) / light - 1
        return each.mean(), each.std(ddof=1) / np.sqrt(len(each))

    mean, error = bias()
    assert abs(mean) < 0.02 and abs(mean) < 3.5 * error
    monkeypatch.setattr(adaptive, "assess", by_pixel)
    mean, error = bias()
    assert mean < -0.03 and mean < -5 * error


@pytest.mark.slow
def test_gradients_are_shared_out_by_what_is_quick(render):
    """Where no method is named: those of a network would cost more than they gain."""
    stack = render(32, method="auto")
    assert stack.attributes["ngpt:adaptive"] == "wcv"
    same(stack, render(32, method="wcv"))


@pytest.mark.parametrize("sampler", [pytest.param("primal", marks=pytest.mark.slow), "gpt"])
def test_an_error_is_reached(render, renderer, sampler):
    method = "primal" if sampler == "primal" else "wcv"
    stack = render(None, 1, "diffuse", sampler, 0.1, method)
    assert 0.05 < stack.attributes["ngpt:error"] <= 0.1
    error = relmse_trimmed(reconstruct(stack, method).image, *halves(renderer, "diffuse"))
    assert np.sqrt(error) == pytest.approx(0.09, rel=0.5)
    ended = render(32, 1, "diffuse", sampler, 1e-4, method)
    assert ended["samples"].mean() == 32 and ended.attributes["ngpt:error"] > 1e-4


def test_an_error_is_reached_in_few_steps(render, monkeypatch):
    """Errors fall with the root of the samples. 200 are needed here: after 128, the next step goes there, and not far
    beyond."""
    taken = [16.0]

    def shared_out(need, n, samples):
        blocks = share_out(need, n, samples)
        taken.append(taken[-1] + adaptive.BLOCK * blocks.mean())
        return blocks

    monkeypatch.setattr(adaptive, "share_out", shared_out)
    monkeypatch.setattr(
        adaptive, "assess", lambda stack, method: Assessment(np.ones(32 * 32), taken[-1] ** -0.5, method)
    )
    render(None, 1, "diffuse", "primal", 200**-0.5, "primal", with_features=False)
    assert taken[:4] == [16, 32, 64, 128] and len(taken) == 5 and 200 <= taken[4] <= 224


def test_an_error_and_counts_are_said_and_written(renderer, command):
    options = "--size 24x16 --for wcv --sampler gpt --spp 48 --json"
    said = command(f"render diffuse -o error.exr --error 0.5 {options}")
    assert "'wcv' is expected to have an error of" in said
    assert json.loads(command.output)["adaptive"] == "wcv" and json.loads(command.output)["error"] <= 0.5
    command(f"render diffuse -o stack.exr --adaptive {options}")
    stack = ngpt.read("stack.exr")
    assert stack.attributes["ngpt:spp"] == 48 and stack["samples"].mean() == 48 and stack["samples"].max() > 48
    command("info stack.exr")
    assert "samples" in command.output


def test_a_pilot_chooses_for_a_method(renderer, command, monkeypatch):
    """What it chose is rendered, in the time that is left, and written down."""
    asked = []

    def plan(scene, request, pilot):
        asked.append((request.seconds, request.method))
        return plans.Plan("primal", "oidn", True, 1.5, "for a test")

    monkeypatch.setattr(plans, "plan", plan)
    said = command("render diffuse -o stack.exr --size 24x16 --time 60 --for auto")
    assert asked == [(60.0, "auto")] and "method 'oidn': for a test" in said
    assert "then: ngpt denoise stack.exr, which takes method 'oidn'" in said
    attributes = ngpt.read("stack.exr").attributes
    assert attributes["ngpt:for"] == "oidn" and attributes["ngpt:sampler"] == "primal"
    # The first 16 samples of those that are shared out are rendered in any case, and may have taken all the time.
    assert "adaptive samples" in said and attributes["ngpt:spp"] >= 16 and attributes["ngpt:seconds"] < 50
