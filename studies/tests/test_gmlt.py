"""Metropolis chains over the random numbers of paths: their mutations, what they count, and what they find."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unbiased import load

from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.render import render_stack

SIZE = (16, 12)


@pytest.fixture
def chains(renderer):
    """The module, in the renderer's variant."""
    from ngpt_studies.gmlt import chains

    return chains


def test_small_steps_go_either_way_and_around(chains):
    rng, small, large = np.random.default_rng(0), chains.SMALLEST, chains.LARGEST
    x = rng.random(100_000, np.float32)
    y = np.array(chains.small_step(mi.Float(x), mi.Float(rng.random(x.size, np.float32))), np.float64)
    assert np.all((y >= 0) & (y < 1))
    step = (y - x + 0.5) % 1 - 0.5
    assert np.all((np.abs(step) > small * 0.999) & (np.abs(step) < large * 1.001))
    # As many of each length to either side, and no drift: the density back is that of the way there.
    there, back = (np.histogram(sign * step, np.geomspace(small, large, 9))[0] for sign in (1, -1))
    assert np.all(np.abs(there - back) < 5 * np.sqrt(there + back))
    # Uniform numbers stay uniform.
    counts = np.histogram(y, 50, (0, 1))[0]
    assert np.square(counts - 2000).sum() / 2000 < 100
    # Around both ends, and what rounds to 1 is 0.
    ends = np.array(chains.small_step(mi.Float([0.0, 1 - 2**-24, 1e-9]), mi.Float([0.1, 0.9, 0.49999])))
    assert ends[0] > 0.98 and ends[1] < 0.02 and 0 <= ends[2] < 1


def test_acceptance_balances_every_pair_of_states(chains):
    """f(x) a(x -> y) = f(y) a(y -> x); from and to what has no value as well."""
    f = np.array([1e-20, 1e-3, 0.5, 0.5, 2, 7, 1e6], np.float32)
    x, y = (mi.Float(a.ravel()) for a in np.meshgrid(f, f))
    there, back = chains.acceptance(x, y), chains.acceptance(y, x)
    assert np.allclose(x * there, y * back, rtol=1e-6) and dr.all(there <= 1)
    assert chains.acceptance(mi.Float(1), mi.Float(0))[0] == 0


class Steps:
    """Paths whose value is 1, 2 or 4 by their first number; a path of each value puts it onto a pixel of its own."""

    VALUES = np.array([1, 2, 4, 0], np.float32)

    def trace(self, camera, random):
        place = mi.UInt32(camera.position.x / camera.size.x * 4)
        value = dr.gather(mi.Float, mi.Float(self.VALUES), place)
        return {"primal": mi.Color3f(value)}, mi.Color3f(0), {}


@pytest.mark.parametrize("large", [0.0, 0.3, 1.0])
def test_a_chain_visits_paths_in_proportion_to_their_values(renderer, monkeypatch, chains, large):
    """By large steps and small ones, each alone and together. What it counts, proposed states too, is that."""
    monkeypatch.setattr(chains, "LARGE_STEPS", large)
    scene = load(mi, "diffuse", (4, 1))
    camera, film = CameraSamples(scene.sensors()[0], 3, 4096), GradientFilm(4, 1, batches=True)
    layers, _, _ = Steps().trace(camera, None)
    f = chains.value_of(layers)
    # Starts in proportion to f, as a pass chooses them, in an order that says nothing
    rng, values = np.random.default_rng(1), np.array(f)
    start = mi.UInt32(rng.choice(values.size, 4096, p=values.astype(np.float64) / values.sum(dtype=np.float64)))
    rate = chains.run(Steps(), camera, start, layers, f, film, steps=40, scale=lambda f: dr.rcp(f))
    visits = np.array(film.splats("primal").totals()[0])
    assert visits.sum() == pytest.approx(4096 * 40, rel=1e-5)  # every step counts one, whatever is accepted
    assert np.allclose(visits / visits.sum(), Steps.VALUES / 7, atol=0.015)
    # Of independent proposals: the mean of min(1, f'/f) over pairs of states
    pairs = np.minimum(1, Steps.VALUES[None] / Steps.VALUES[:3, None]).mean(axis=1) @ Steps.VALUES[:3] / 7
    if large == 1:
        assert np.array(rate).mean() == pytest.approx(pairs, abs=0.01)
    assert np.array(rate).mean() > 0.4


def test_numbers_that_do_not_change_make_the_same_path(monkeypatch, chains):
    """What a chain remembers of a candidate is the candidate, and what it accepted is what it remembers."""
    counts = dr.zeros(mi.UInt32, 2)
    acceptance = chains.acceptance

    def counted(f, proposed):
        for i, which in enumerate((dr.abs(f - proposed) <= 1e-4 * f, f >= 0)):
            dr.scatter_add(counts, mi.UInt32(1), mi.UInt32(i), which)
        return acceptance(f, proposed)

    monkeypatch.setattr(chains, "small_step", lambda x, u: x)
    monkeypatch.setattr(chains, "acceptance", counted)
    monkeypatch.setattr(chains, "LARGE_STEPS", 0.3)
    render_stack(load(mi, "glossy", SIZE), 8, 1, "gmlt", unbiased=True)
    same, steps = np.array(counts, np.float64)
    assert steps >= 3 * 8 * SIZE[0] * SIZE[1]
    # Large steps lead to paths of other values, but for some that end with those of a candidate
    assert same / steps == pytest.approx(0.7, abs=0.03)
