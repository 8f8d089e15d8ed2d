"""Samples shared out by the error of the result."""

from itertools import count

import numpy as np
import pytest
from unbiased import load, same

from ngpt.errors import NgptError
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

SIZE = (24, 16)


def render(mi, spp, seed=0, scene="glossy", sampler="gpt", error=None, method="wcv", **options):
    from data_gen.adaptive import Adaptive
    from data_gen.render import render_stack

    scene = load(mi, scene, SIZE) if isinstance(scene, str) else scene
    return render_stack(scene, spp, seed, sampler, adaptive=Adaptive(error, method), **options)


def test_counts_are_proportional_to_what_is_needed(renderer, rng):
    from data_gen.adaptive import share_out

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


def test_the_mean_number_is_kept_and_passes_are_not_seen(renderer, monkeypatch):
    from data_gen import passes

    stack = render(renderer, 40, 3)
    samples = stack["samples"]
    assert samples.mean() == 40 and samples.min() == 16 and samples.max() > 60
    assert stack.attributes["ngpt:spp"] == 40 and stack.attributes["ngpt:adaptive"] == "wcv"
    calls = []
    monkeypatch.setattr(passes, "FIRST_LANES", 16 * 100)
    monkeypatch.setattr(passes, "PASS_SECONDS", 0.3)
    same(stack, render(renderer, 40, 3, progress=lambda *call: calls.append(call)))
    assert calls[0] == (0, 40) and calls[-1] == (40, 40) and len(calls) > 5


def test_what_ends_it_is_not_seen(renderer, monkeypatch):
    """By Ctrl-C it is the beginning of any longer render: the same number of samples gives the same counts."""
    from data_gen import passes

    monkeypatch.setattr(passes, "PASS_SECONDS", 0.3)
    calls = []
    stopped = render(renderer, 1 << 20, 3, stop=lambda: len(calls) > 7, progress=lambda *call: calls.append(call))
    mean = stopped["samples"].mean() if "samples" in stopped else stopped.attributes["ngpt:spp"]
    if mean >= 33:
        few, many = (s["samples"].astype(int) for s in (render(renderer, int(mean), 3), stopped))
        assert (few <= many).all() and (many - few).sum() < few.size + 16


def test_time_is_kept(renderer, monkeypatch):
    """On a clock that a look at it takes forward, whatever the machine is at."""
    from data_gen import adaptive

    looks = count()
    monkeypatch.setattr(adaptive.time, "perf_counter", lambda: 0.05 * next(looks))
    stack = render(renderer, None, 3, load(renderer, "diffuse", SIZE), seconds=2.0)
    assert 1.0 < 0.05 * next(looks) < 2.5
    assert stack.attributes["ngpt:spp"] >= 16


def test_a_firefly_gets_no_samples_for_all_around_it(renderer, rng):
    """A pixel whose noise is a thousand times that of others is one pixel, and left out of the error of all."""
    from data_gen.adaptive import assess

    primal = rng.uniform(0.5, 1.0, (48, 48, 3)).astype(np.float32)
    variance = np.full_like(primal, 1e-4)
    calm = assess(GradientStack({"primal": primal, "primal_var": variance}), "primal")
    variance[20, 20] = 100.0
    wild = assess(GradientStack({"primal": primal, "primal_var": variance}), "primal")
    assert wild.error == pytest.approx(calm.error, rel=0.1)
    assert np.all(wild.relative < 1.5 * calm.relative)


def test_what_a_choice_takes_is_known_ahead(renderer, monkeypatch):
    """A method that takes long for its pixels is not begun where it would end too late."""
    from data_gen import adaptive

    calls = []

    def slow(stack, method):
        calls.append(stack.width * stack.height)
        return adaptive.Assessment(np.ones(calls[-1]), 1.0, method)

    monkeypatch.setattr(adaptive, "assess", slow)
    monkeypatch.setattr(adaptive, "_PART", 40)
    scene = load(renderer, "diffuse", (100, 80))
    # A clock on which all takes long: nothing is begun when time is over.
    clock = count()
    monkeypatch.setattr(adaptive.time, "perf_counter", lambda: float(next(clock)))
    stack = render(renderer, None, 0, scene, "primal", method="primal", seconds=0.1)
    assert not calls and stack.attributes["ngpt:spp"] == 16
    stack = GradientStack({"primal": np.ones((80, 100, 3), np.float32)})
    # And one on which the method takes 20 us a pixel.
    monkeypatch.setattr(adaptive.time, "perf_counter", lambda: 2e-5 * sum(calls))
    assert adaptive.seconds_to_assess(stack, "primal") == pytest.approx(0.16) and calls == [100, 1600]
    assert adaptive.seconds_to_assess(GradientStack({"primal": stack["primal"][:79, :80]}), "primal") == 0.0


def test_samples_go_where_the_error_is(renderer):
    """The same number makes a better image, by the method they were meant for."""
    from data_gen.render import render_stack

    scene = load(renderer, "glossy", (48, 32))
    halves = [render_stack(scene, 512, 100 + i, "primal", with_features=False)["primal"] for i in range(2)]
    errors = []
    for seed in range(3):
        stacks = (render_stack(scene, 96, seed, "gpt"), render(renderer, 96, seed, scene))
        errors.append([relmse_trimmed(reconstruct(stack, "wcv").image, *halves) for stack in stacks])
    even, adaptive = np.mean(errors, axis=0)
    assert adaptive < 0.95 * even


@pytest.mark.slow
def test_samples_that_choose_hardly_bias_the_mean(renderer, monkeypatch):
    """They stay in the means: were each pixel judged by its own noise alone, the image would be too dark."""
    from data_gen import adaptive
    from data_gen.render import render_stack

    def by_pixel(stack, method):
        return adaptive.Assessment(np.sqrt(stack["primal_var"].sum(axis=-1)).ravel(), 1.0, method)

    scene = load(renderer, "glossy", SIZE)
    light = render_stack(scene, 8192, 99, "primal", with_features=False)["primal"].mean()

    def bias():
        """In the mean over renders, and its standard error."""
        stacks = [
            render(renderer, 32, seed, scene, "primal", method="primal", with_features=False) for seed in range(10)
        ]
        each = np.array([stack["primal"].mean() for stack in stacks]) / light - 1
        return each.mean(), each.std(ddof=1) / np.sqrt(len(each))

    mean, error = bias()
    assert abs(mean) < 0.02 and abs(mean) < 3.5 * error
    monkeypatch.setattr(adaptive, "assess", by_pixel)
    mean, error = bias()
    assert mean < -0.03 and mean < -5 * error


@pytest.mark.slow
def test_gradients_are_shared_out_by_what_is_quick(renderer):
    """Where no method is named: those of a network would cost more than they gain."""
    stack = render(renderer, 32, method="auto")
    assert stack.attributes["ngpt:adaptive"] == "wcv"
    same(stack, render(renderer, 32, method="wcv"))


@pytest.mark.parametrize("sampler", ["primal", "gpt"])
def test_an_error_is_reached(renderer, sampler):
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (48, 32))
    halves = [render_stack(scene, 512, 100 + i, "primal", with_features=False)["primal"] for i in range(2)]
    method = "primal" if sampler == "primal" else "wcv"
    stack = render(renderer, None, 1, scene, sampler, 0.1, method)
    assert 0.05 < stack.attributes["ngpt:error"] <= 0.1
    assert np.sqrt(relmse_trimmed(reconstruct(stack, method).image, *halves)) == pytest.approx(0.09, rel=0.5)
    ended = render(renderer, 32, 1, scene, sampler, 1e-4, method)
    assert ended["samples"].mean() == 32 and ended.attributes["ngpt:error"] > 1e-4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 31}, "31 samples per pixel are too few .* from 32 on"),
        ({"spp": 64, "sampler": "bdpt"}, "'bdpt' depend on each other.* use: gpt, gpt-basic, gpt-simple, primal"),
        ({"spp": 64, "sampler": "gbdpt"}, "'gbdpt' depend on each other"),
        ({"spp": 64, "reuse": True}, "'reuse' and 'shift=manifold' need samples of all pixels"),
        ({"spp": None, "error": 0.0}, "an error of 0 is never reached"),
        ({"spp": None}, "neither a number of samples"),
        ({"spp": 64, "method": "magic"}, "unknown method 'magic'"),
        ({"spp": 64, "sampler": "primal", "method": "l1"}, "needs"),
    ],
)
def test_refusals(renderer, options, message):
    with pytest.raises(NgptError, match=message):
        render(renderer, **({"scene": "diffuse"} | options))
