"""Which sampler and method a pilot chooses: by the error that it expects of the final image."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from unbiased import load

from ngpt.errors import NgptError
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

pytest.importorskip("mitsuba")

from data_gen.adaptive import gain
from data_gen.choosing import pipelines, plans, trials
from data_gen.choosing.pipelines import Pipeline, choose, measure, methods_for
from data_gen.choosing.trials import Pilot, Trial, by_processor, try_out
from data_gen.request import RenderRequest

SHAPE = (48, 64)


def pipeline(sampler="gpt", method="wcv", error=0.01, fall=-0.8, seconds=0.01, after=0.0, **more):
    return Pipeline(sampler, method, 16, error, fall, seconds, after, **more)


def truth():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 16.0
    image = 1 + 0.5 * np.sin(x + 2 * y)[..., None] * np.array([1.0, 0.8, 0.5])
    image[12:30, 20:40] *= 0.3
    return image


def stack(rng, seed, spp=8, variance=0.5, of_gradients=None):
    """A stack of ``truth``, with the relative variance of a sample; and of gradients, where there are any."""
    image = truth()
    attributes = {"ngpt:spp": spp, "ngpt:seed": str(seed), "ngpt:sampler": "test", "ngpt:normalSpace": "camera"}
    noise = variance / spp * image**2
    layers = {"primal": image + rng.normal(0, np.sqrt(noise)), "primal_var": noise}
    layers["albedo"], layers["normal"] = np.full_like(image, 0.5), np.broadcast_to([0, 0, 1.0], image.shape)
    layers["depth"] = np.ones((*SHAPE, 1))
    if of_gradients is not None:
        for name, axis in (("dx", 1), ("dy", 0)):
            d = np.diff(image, axis=axis, append=np.take(image, [-1], axis))
            var = np.full_like(d, of_gradients / spp)
            layers[name], layers[f"{name}_var"] = d + rng.normal(0, np.sqrt(var)), var
    return GradientStack({k: np.asarray(v, np.float32) for k, v in layers.items()}, attributes)


def test_what_is_measured_is_the_true_error(renderer, rng, monkeypatch):
    """The estimate holds for every method, whatever it blurs: no pilot knows the truth."""
    monkeypatch.setattr(pipelines, "WITH_GRADIENTS", ("wcv", "ngpt-fast"))
    monkeypatch.setattr(pipelines, "WITHOUT", ("primal", "oidn"))
    made = {
        "gpt": Trial([stack(rng, i, of_gradients=0.01) for i in range(4)], 0.02),
        "primal": Trial([stack(rng, i) for i in range(4)], 0.01),
    }
    found = measure(made)
    names = {(p.sampler, p.method) for p in found}
    assert names == {(s, m) for s in made for m in methods_for(s)} and ("gpt", "wcv") in names
    for p in found:
        four = [stack(rng, i, p.spp, of_gradients=0.01 if p.sampler == "gpt" else None) for i in range(4)]
        errors = [relmse_trimmed(reconstruct(s, p.method).image, truth()) for s in four]
        # Twice the square root of how far a mean over so few pixels can be off
        assert p.error == pytest.approx(np.mean(errors), rel=0.35, abs=1e-4), p
    noise = next(p for p in found if (p.sampler, p.method, p.shared) == ("primal", "primal", False))
    assert noise.step == pytest.approx(-1, abs=0.15)


FLAT = pipeline("primal", "oidn", error=0.005, fall=-0.4, seconds=0.005)
STEEP = pipeline("gpt", "wcv", error=0.01, fall=-0.9)
QUICK, SLOW = pipeline(error=0.011), pipeline(method="ngpt-combine", after=0.5)
EVEN, SHARED, DEAR = pipeline(), pipeline(adaptive=0.6, choosing=0.01), pipeline(adaptive=0.95, choosing=1.0)


@pytest.mark.parametrize(
    ("both", "seconds", "best"),
    [
        # A denoiser that hardly improves wins at first, gradients in the end.
        ([FLAT, STEEP], 0.2, FLAT),
        ([FLAT, STEEP], 20.0, STEEP),
        # The time of the method counts.
        ([QUICK, SLOW], 1.0, QUICK),
        ([QUICK, SLOW], 100.0, SLOW),
        # Samples are shared out where that pays: not where there are too few.
        ([EVEN, SHARED], 2.0, SHARED),
        ([EVEN, SHARED], 0.3, EVEN),
        ([EVEN, DEAR], 10.0, EVEN),
    ],
)
def test_the_best_depends_on_the_time(both, seconds, best):
    assert choose(both, seconds)[0] == best
    assert all(math.isfinite(p.expected(p.samples(seconds))) for p in choose(both, seconds))


def test_what_fits_into_a_time():
    assert SLOW.samples(1.0) == pytest.approx(50) and QUICK.samples(1.0) == pytest.approx(100)
    assert choose([SLOW], 0.4) == []
    assert SHARED.shared and not EVEN.shared and SHARED.samples(2.0) < EVEN.samples(2.0)


def test_the_gain_of_shared_out_samples(renderer):
    assert gain(np.ones(100)) == pytest.approx(1)
    need = np.where(np.arange(100) < 50, 1.0, 2.0)
    assert gain(need) == pytest.approx(1.5**2 / 2.5)


def ticking(tick):
    """A clock that goes on by as much whenever it is looked at."""
    seconds = itertools.count()
    return lambda: tick * next(seconds)


def planned(scene, seconds, method="auto", **more):
    return plans.plan(scene, RenderRequest(scene, seconds=seconds, method=method), **more)


def test_a_plan_fits_into_the_time_and_leaves_the_scene_as_it_was(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(plans, "PIXELS", 24 * 16)
    monkeypatch.setattr(plans, "candidates", lambda scene, **_: ["gpt", "primal"])
    found = planned(scene, 200.0, pilot=Pilot(ticking(0.01)))
    assert found.sampler in ("gpt", "primal") and found.method in plans.methods_for(found.sampler)
    assert 0 < found.render < 200 and "expected to leave an error of" in found.reason
    assert tuple(scene.sensors()[0].film().size()) == (48, 32)
    with pytest.raises(NgptError, match="unknown method 'none'"):
        planned(scene, 200.0, "none")
    # Where there is no time for a pilot the description decides, and what is left is rendered.
    found = planned(scene, 1.0, "wcv", pilot=Pilot(ticking(0.1)))
    assert (found.sampler, found.method, found.shared) == ("gpt", "wcv", False) and 0 < found.render < 1
    assert "no time for a pilot" in found.reason
    found = planned(scene, 30.0, pilot=Pilot(ticking(5.0)))
    assert (found.sampler, found.method) == ("gpt", "auto") and 0 < found.render < 30


def test_stop_ends_a_pilot_and_the_render_begins(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (48, 32))
    told = []
    found = planned(scene, 4000.0, pilot=Pilot(said=told.append, stop=lambda: len(told) > 1))
    assert [line.split(";")[0] for line in told] == ["pilot: trying 'primal'", "pilot: trying 'bdpt'"]
    assert (found.sampler, found.method) == ("primal", "oidn") and found.render > 0


def test_samplers_are_tried_while_there_is_time(renderer, monkeypatch):
    """Pilots have a tenth of the time, trials two thirds of it; and the less time, the smaller the images."""
    scene = load(renderer, "diffuse", (48, 32))
    monkeypatch.setattr(plans, "PIXELS", 24 * 16)
    monkeypatch.setattr(plans, "candidates", lambda scene, **_: ["gpt", "primal", "bdpt", "ppm"])
    tried, sizes = [], []

    def try_out(scene, name, limit, pilot):
        tried.append((name, limit))
        for _ in range(8):
            compiled = pilot.clock()
        sizes.append(tuple(int(n) for n in scene.sensors()[0].film().size()))
        return None, compiled

    monkeypatch.setattr(trials, "try_out", try_out)
    cases = ((95.0, 0, None), (150.0, 1, (9, 6)), (300.0, 2, (18, 12)), (750.0, 3, (24, 16)), (1500.0, 4, (24, 16)))
    for seconds, names, size in cases:
        tried.clear()
        found = planned(scene, seconds, pilot=Pilot(ticking(1.0)))
        assert found.sampler == "gpt" and "no time for a pilot" in found.reason
        assert [name for name, _ in tried] == ["gpt", "primal", "bdpt", "ppm"][:names]
        assert (sizes or [None])[-1] == size
        assert all(0 < limit < 0.1 * seconds for _, limit in tried)


def test_a_busy_moment_moves_no_sampler_against_another(rng):
    """Samples are compared by processor seconds, and cost in sum what the wall says."""
    found = by_processor({"gpt": Trial([], 0.9, 0.6), "primal": Trial([], 0.1, 0.4)})
    assert [trial.seconds for trial in found.values()] == pytest.approx([0.6, 0.4])
    unknown = {"gpt": Trial([], 0.9, 0.6), "primal": Trial([], 0.1)}
    assert by_processor(unknown) == unknown and by_processor({}) == {}


def test_a_trial_measures_both_clocks_on_a_processor(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (16, 12))
    trial, _ = trials.try_out(scene, "primal")
    assert trial.seconds > 0 and trial.processor > 0
    monkeypatch.setattr(trials, "mi", SimpleNamespace(variant=lambda: "cuda_ad_rgb"))
    trial, _ = trials.try_out(scene, "primal")
    assert trial.seconds > 0 and trial.processor == 0


def test_all_that_follows_a_render_is_counted_at_its_size(renderer, monkeypatch):
    """Methods are measured on small images: they grow a little slower than the pixels, and files and a process come
    on top."""
    scene = load(renderer, "diffuse", (96, 64))
    monkeypatch.setattr(plans, "PIXELS", 48 * 32)
    monkeypatch.setattr(plans, "try_all", lambda *args, **options: {"gpt": None})
    monkeypatch.setattr(plans, "measure", lambda *args, **options: [pipeline(seconds=0.01, after=0.5)])
    (found,) = plans.explore(scene, 1e4)
    assert found.seconds == pytest.approx(0.04)
    assert found.after == pytest.approx(0.5 * 4**0.9 + 0.8 + 3.7 * 96 * 64 / 1e6)
    # Where no pilot measured it, at most half of the time is kept for the method.
    assert planned(scene, 0.2, pilot=Pilot(lambda: 0.0)).render == pytest.approx(0.1)
    assert planned(scene, 20.0, "wcv", pilot=Pilot(lambda: 0.0)).render == pytest.approx(20 - 0.8 - 6.7 * 96 * 64 / 1e6)


def test_slow_compilation_keeps_other_samplers_out(renderer, monkeypatch):
    """ppm takes one and a half times as long as gpt: where that took 30 s, it is not begun in a rest of 40."""
    scene, tried = load(renderer, "diffuse", (16, 12)), []
    for took, names in ((30.0, ["gpt"]), (20.0, ["gpt", "ppm"])):
        tried.clear()

        def try_out(scene, name, limit, pilot, took=took):
            tried.append(name)
            return None, pilot.clock() + took

        monkeypatch.setattr(trials, "try_out", try_out)
        trials.try_all(scene, ["gpt", "ppm"], lambda _: 40.0, pilot=Pilot(ticking(0.1)))
        assert tried == names


def test_a_sampler_that_takes_too_long_is_not_tried(renderer):
    scene = load(renderer, "diffuse", (16, 12))
    # A second to compile; a render of 8 samples takes another, and there are four of these and two of 16.
    assert try_out(scene, "primal", 8.5, Pilot(ticking(1.0)))[0] is None
    assert len(try_out(scene, "primal", 9.5, Pilot(ticking(1.0)))[0].stacks) == 4
    assert try_out(scene, "primal", pilot=Pilot(stop=lambda: True))[0] is None
    # Where compilation takes more than half of the time, no stack is begun.
    clock = ticking(1.0)
    assert try_out(scene, "primal", 1.9, Pilot(clock)) == (None, 1.0) and clock() == 2.0


def test_a_method_is_tried_where_it_can_run(renderer):
    assert methods_for("primal", "wcv") == [] and methods_for("gpt", "wcv") == ["wcv"]
    assert methods_for("primal", "primal") == ["primal"]
    for sampler in ("gpt", "primal", "bdpt"):
        assert all(not METHODS[m].missing() for m in methods_for(sampler))
