"""How a render is split into passes: never seen in its bits, bounded in memory and time."""

import subprocess
import sys
from contextlib import contextmanager

import pytest
from unbiased import load, same

from ngpt.errors import NgptError

pytest.importorskip("mitsuba")

from data_gen import passes
from data_gen import render as rendering
from data_gen.adaptive import Adaptive
from data_gen.budget import Budget, Watch
from data_gen.passes import film_within, foretold, render_passes
from data_gen.paths.streams import first_round
from data_gen.render import render_stack
from data_gen.scenes.load import set_film_size


def test_large_images_with_small_blocks(renderer, monkeypatch):
    scene = load(renderer, "glossy", (33, 21))
    monkeypatch.setattr(passes, "_BLOCK_LANES", 33 * 21 * 5)
    whole = render_stack(scene, 14, 7, sampler="gpt", unbiased=True)
    assert passes.block_of_samples(33 * 21) == 4
    monkeypatch.setattr(passes, "PASS_SECONDS", 1e-9)
    same(whole, render_stack(scene, 14, 7, sampler="gpt", unbiased=True))


def test_passes_do_not_move_blocks_within_packets(renderer):
    # 33 * 21 * 4 lanes are no whole number of packets of 16: a second block would start in the middle of a packet.
    for width, many in ((32, True), (33, False)):
        _, _, blocks = film_within(1000, load(renderer, "diffuse", (width, 21)).sensors()[0], 4)
        assert (blocks > 1) == many


def test_time_is_kept_and_its_samples_are_those_of_spp(renderer):
    scene = load(renderer, "diffuse", (64, 48))
    how = {"sampler": "gpt", "unbiased": True}
    render_stack(scene, 1, **how)
    calls = []
    stack = render_stack(scene, None, 3, progress=lambda *call: calls.append(call), seconds=0.4, **how)
    assert calls[0] == (0, 1) and calls[-1] == (1, 1)
    spp = stack.attributes["ngpt:spp"]
    assert spp > 1 and stack.attributes["ngpt:samplerOptions"] == "points=rounds"
    same(stack, render_stack(scene, spp, 3, points="rounds", sampler="gpt", unbiased=True))
    assert render_stack(scene, 2, seconds=100, sampler="gpt", unbiased=True).attributes["ngpt:spp"] == 2
    assert render_stack(scene, None, seconds=1e-6, **how).attributes["ngpt:spp"] >= 1  # at least something


class Fake:
    """A sampler whose passes take a known time by a clock of its own; it notes the blocks that it is given."""

    def __init__(self, mitsuba, monkeypatch, begin, each, compile_once=0.0):
        self.mitsuba, self.begin, self.each, self.compile_once = mitsuba, begin, each, compile_once
        self.now, self.blocks = 0.0, []
        monkeypatch.setattr(passes.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(passes, "compilation", self.compilation)

    @contextmanager
    def compilation(self):
        compiled = []
        yield compiled
        self.now += self.compile_once
        compiled.append(self.compile_once)
        self.compile_once = 0.0

    def __call__(self, camera, film):
        lanes = len(camera.pixel)
        n = lanes // camera.pixels
        self.now += self.begin + self.each * n
        self.blocks += [camera.block] * (n // camera.block)
        film.put("primal", self.mitsuba.Color3f(1) + self.mitsuba.Float(camera.sample))


@pytest.mark.parametrize(
    ("begin", "each", "compile_once"),
    [(0, 0.06, 0), (0.5, 0.06, 4), (0, 0.4, 4), (0.5, 0.4, 0), (0, 1.7, 0), (0.5, 1.7, 4)],
)
def test_time_is_kept_whatever_a_sample_takes(renderer, monkeypatch, begin, each, compile_once):
    sensor = load(renderer, "diffuse", (128, 64)).sensors()[0]
    fake = Fake(renderer, monkeypatch, begin, each, compile_once)
    film = render_passes(fake, sensor, 0, Budget(seconds=10), points="rounds")
    assert 8 <= fake.now <= 12
    # What the header says gives the same blocks again.
    again = Fake(renderer, monkeypatch, 0, 0)
    render_passes(again, sensor, 0, Budget(film.samples), points="rounds")
    assert again.blocks == fake.blocks and sum(fake.blocks) == film.samples


def test_processor_time_buys_as_much_on_a_busy_machine(renderer, monkeypatch):
    """Of four seconds on the wall this process gets one."""
    sensor = load(renderer, "diffuse", (128, 64)).sensors()[0]
    fake = Fake(renderer, monkeypatch, 0, 0.4, 8)
    render_passes(fake, sensor, 0, Budget(seconds=10, clock=lambda: fake.now / 4), points="rounds")
    assert 32 <= fake.now <= 48


def test_what_ends_before_its_time_says_so(renderer, monkeypatch):
    sensor, calls = load(renderer, "diffuse", (128, 64)).sensors()[0], []
    fake = Fake(renderer, monkeypatch, 0, 0.5)
    render_passes(fake, sensor, 0, Budget(16, 60), Watch(lambda *call: calls.append(call)), points="rounds")
    assert calls[0] == (0, 60) and calls[-1] == (8, 8)


def test_the_time_of_a_pass_is_foretold():
    assert foretold([(100, 3.0)]) == (0.0, 0.03)
    # The first compiles.
    assert foretold([(100, 30.0), (100, 0.4), (300, 0.8), (50, 0.3)]) == pytest.approx((0.2, 0.002))
    assert foretold([(100, 30.0), (100, 0.4), (100, 0.5)]) == pytest.approx((0.0, 0.004))
    # Never nothing at all, however the times of busy machines fall.
    begin, each = foretold([(1, 9.0), (100, 0.4), (300, 0.2), (200, 0.3)])
    assert begin >= 0 and each > 0


def test_what_takes_longer_than_the_time_is_rendered_once(renderer, monkeypatch):
    sensor = load(renderer, "diffuse", (128, 64)).sensors()[0]
    fake = Fake(renderer, monkeypatch, 0, 20)
    assert render_passes(fake, sensor, 0, Budget(seconds=10), points="rounds").samples == 1
    fake = Fake(renderer, monkeypatch, 0, 3)
    assert render_passes(fake, sensor, 0, Budget(seconds=10), batch=4).samples == 4


def test_stopping_keeps_the_samples_done(renderer):
    scene = load(renderer, "diffuse", (256, 256))
    stack = render_stack(scene, 1 << 20, 3, "primal", stop=lambda: True, points="rounds", unbiased=True)
    assert 1 <= stack.attributes["ngpt:spp"] < 100
    same(stack, render_stack(scene, stack.attributes["ngpt:spp"], 3, "primal", points="rounds", unbiased=True))


def test_sizes_that_memory_cannot_hold(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (4, 4))
    set_film_size(scene, (20000, 10000))
    # More than a machine has is no advice.
    monkeypatch.setattr(passes, "machine_memory", lambda: 2**34)
    with pytest.raises(NgptError, match=r"need \d+ MiB .*, and this machine has 16384 MiB; render a smaller image$"):
        render_stack(scene, 1, sampler="gpt", unbiased=True)
    monkeypatch.setattr(passes, "machine_memory", lambda: 2**44)
    with pytest.raises(NgptError, match=r"20000x10000 pixels need \d+ MiB .*, and 6144 MiB .* pass --memory \d+"):
        render_stack(scene, 1, sampler="gpt", unbiased=True)
    set_film_size(scene, (40, 30))
    with pytest.raises(NgptError, match=r"pass --memory (\d+)") as error:
        render_stack(scene, 1, memory=1, sampler="gpt", unbiased=True)
    assert render_stack(
        scene, 1, memory=int(str(error.value).split("--memory ")[1].split(",")[0]), sampler="gpt", unbiased=True
    )


class Begun(Exception):
    """A render has begun, with so many MiB for film and paths."""


def test_what_fits_into_some_memory_fits_into_more(renderer, monkeypatch):
    """The cache of tails is there where film and paths fit beside it, and what an error names is enough."""
    scene = load(renderer, "diffuse", (4, 4))
    set_film_size(scene, (640, 360))

    def begin(sample, sensor, seed, budget, watch, **how):
        film_within(budget.memory, sensor, budget.spp, how["lane_bytes"], net=first_round(how["points"], budget.spp))
        raise Begun(budget.memory)

    def left(memory):
        try:
            render_stack(scene, 16, sampler="gpt", memory=memory)
        except Begun as begun:
            return begun.args[0]
        except NgptError as error:
            named.add(int(str(error).split("--memory ")[1].split(",")[0]))
        return 0

    named: set[int] = set()
    monkeypatch.setattr(rendering, "render_passes", begin)
    found = {memory: left(memory) for memory in range(40, 1400, 40)}
    (least,) = named
    whole, shared = ([m for m, rest in found.items() if rest and (rest < m) == cached] for cached in (False, True))
    assert min(found) < least <= min(whole) and max(whole) < min(shared)
    assert sorted([*whole, *shared]) == [m for m in found if m >= least]
    assert left(least) == least and left(least - 1) == 0


def adaptive(error=None, method="wcv", **options):
    return {"spp": 64, "sampler": "gpt", "adaptive": Adaptive(error, method)} | options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 0}, "0 samples"),
        ({"spp": 1, "seed": -1}, "seed -1"),
        ({"spp": 1, "sampler": "x"}, "auto, gpt, gpt-basic"),
        ({"spp": 2**31}, "from 1 to"),
        ({"spp": None, "seconds": 0}, "cannot render for 0 s"),
        ({"spp": None, "seconds": float("nan")}, "cannot render for nan s"),
        ({"spp": 1, "memory": 0}, "0 MiB"),
        ({"sampler": "bdpt", "joined_depth": 0}, "'0' is not allowed; it takes a whole number from 1 to 64$"),
        (adaptive(spp=31), "at least 32 samples per pixel, not 31"),
        (adaptive(sampler="bdpt"), "'bdpt' depend on each other.* use one of: gpt, gpt-basic, gpt-simple, primal"),
        (adaptive(reuse=True), "'reuse' needs samples of all pixels"),
        (adaptive(0.0, spp=None), "an error of 0 is never reached"),
        (adaptive(method="magic"), "unknown method 'magic'"),
        (adaptive(method="l1", sampler="primal"), "needs"),
    ],
)
def test_refusals(renderer, options, message):
    with pytest.raises(NgptError, match=message):
        render_stack(load(renderer, "diffuse", (4, 4)), unbiased=True, **{"spp": 1} | options)


# A scene is left over, in a cycle, amid a kernel, and Python looks for such wherever it is allowed to.
LEFT_OVER = """
import gc
from data_gen.backend import use_variant
use_variant()
import mitsuba as mi
from data_gen.render import render_stack
from data_gen.scenes.load import load_scene

held = [load_scene("diffuse", (8, 8))]
held.append(held)

def asked(*arguments, asks=mi.Scene.sample_emitter_direction):
    global held
    answer, held = asks(*arguments), None
    if gc.isenabled():
        gc.collect()
    return answer

mi.Scene.sample_emitter_direction = asked
print(render_stack(load_scene("diffuse", (8, 8)), 1, seed=1, sampler="gpt")["primal"].shape)
assert gc.isenabled()
"""


def test_no_scene_dies_while_a_kernel_is_recorded(renderer):
    run = subprocess.run([sys.executable, "-c", LEFT_OVER], capture_output=True, text=True)
    assert (run.returncode, run.stdout) == (0, "(8, 8, 3)\n"), run.stderr[-300:]
