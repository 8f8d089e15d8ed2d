"""Pixels with samples in different numbers: means, gradients of pairs, variances, the same bits whatever the passes."""

import numpy as np
import pytest
from references import references
from unbiased import assert_unbiased, load, same

from ngpt.stack import GradientStack

pytest.importorskip("mitsuba")

from data_gen import passes
from data_gen.adaptive import UnevenRender
from data_gen.film import GradientFilm
from data_gen.render import render_stack
from data_gen.samplers import find

SIZE = (12, 8)
PIXELS = SIZE[0] * SIZE[1]


def render(mi, scene, blocks, seed=0, sampler="gpt", points="independent", **limits):
    """A render of so many blocks of each pixel, after a first one of all."""
    work = UnevenRender(find(sampler).made(scene), scene.sensors()[0], seed, points=points, **limits)
    work.add(np.ones(PIXELS, int), whole=True)
    work.add(blocks)
    return GradientStack(work.film.develop())


def uneven(rng):
    return rng.integers(0, 5, PIXELS) * (rng.random(PIXELS) < 0.6)


@pytest.mark.parametrize("sampler", ["primal", "gpt", "gpt-basic", "gpt-simple"])
def test_even_counts_are_the_render_of_ever(renderer, sampler):
    scene = load(renderer, "diffuse", SIZE)
    even = render_stack(scene, 48, 3, sampler, points="independent", unbiased=True)
    same(render(renderer, scene, np.full(PIXELS, 2), 3, sampler), even)


@pytest.mark.parametrize(("points", "of_even"), [("independent", "independent"), ("sobol", "rounds")])
def test_each_pixel_has_the_bits_of_its_own_samples(renderer, rng, points, of_even):
    """With any points; of gradients and variances where those are independent."""
    scene, blocks = load(renderer, "glossy", SIZE), uneven(rng)
    layers = render(renderer, scene, blocks, 3, points=points)
    counts = 16 * (1 + blocks.reshape(SIZE[::-1]))
    assert np.array_equal(layers["samples"][..., 0], counts)
    for n in np.unique(counts):
        even, here = render_stack(scene, int(n), 3, "gpt", points=of_even, unbiased=True), counts == n
        assert np.array_equal(layers["primal"][here], even["primal"][here])
        if points == "sobol":
            continue
        for name in ("primal_var", "albedo"):
            assert np.array_equal(layers[name][here], even[name][here], equal_nan=True)
        pairs = here[:, :-1] & here[:, 1:]
        assert np.array_equal(layers["dx"][:, :-1][pairs], even["dx"][:, :-1][pairs])
        assert np.array_equal(layers["dx_var"][:, :-1][pairs], even["dx_var"][:, :-1][pairs])


def test_what_ends_it_is_not_seen(renderer, rng, monkeypatch):
    scene, blocks = load(renderer, "diffuse", SIZE), uneven(rng)
    monkeypatch.setattr(passes, "FIRST_LANES", 16 * 90)
    monkeypatch.setattr(passes, "PASS_SECONDS", 1e-9)  # one block in each pass after the first
    calls = []
    stopped = render(renderer, scene, blocks, stop=lambda: len(calls) > 12, report=lambda: calls.append(0))
    done = stopped["samples"].sum()
    assert 16 * PIXELS < done < 16 * (PIXELS + blocks.sum())
    monkeypatch.undo()
    same(stopped, render(renderer, scene, blocks, most=int(done)))


@pytest.mark.parametrize(
    ("scene", "sampler"),
    [
        ("diffuse", "gpt"),
        pytest.param("glossy", "gpt", marks=pytest.mark.slow),
        pytest.param("diffuse", "gpt-simple", marks=pytest.mark.slow),
    ],
)
def test_uneven_counts_are_unbiased(renderer, rng, scene, sampler):
    """Even where one end of a pair has five times the samples of the other. The layers of variances are right, too."""
    loaded, blocks = load(renderer, scene, SIZE), uneven(rng)
    stacks = [render(renderer, loaded, blocks, seed, sampler) for seed in range(24)]
    assert_unbiased(stacks, references(renderer, scene, SIZE))
    for name in ("primal", "dx", "dy"):
        images = np.stack([stack[name] for stack in stacks])
        if name == "primal" and "caustic" in stacks[0]:
            images -= np.stack([stack["caustic"] for stack in stacks])
        measured = images.var(axis=0, ddof=1)
        predicted = np.mean([stack[f"{name}_var"] for stack in stacks], axis=0)
        known = predicted > 0
        ratio = np.median(measured[known] / predicted[known])
        assert 0.85 < ratio < 1.1, name  # the median of a chi squared of 23 degrees is 0.97


def test_directions_are_means_over_their_own_ends(renderer, rng):
    """Against NumPy: the forward part has the counts of this pixel, and the backward part has those of the other."""
    mi, film = renderer, GradientFilm(3, 1)
    values = {name: rng.normal(size=(3, 4, 16)).astype(np.float32) for name in ("primal", "dx+", "dx-")}
    blocks = [1, 4, 2]
    for number in range(4):
        some = np.flatnonzero(np.array(blocks) > number)
        for name, samples in values.items():
            film.put(name, mi.Color3f(mi.Float(samples[some, number].ravel())))
        film.end_pass(16, some)
    layers = film.develop()

    def statistics(name, pixel):
        samples = values[name][pixel, : blocks[pixel]].astype(float).ravel()
        return samples.mean(), samples.var(ddof=1) / len(samples)

    for pixel in range(2):
        forward, backward = statistics("dx+", pixel), statistics("dx-", pixel + 1)
        assert np.allclose(layers["dx"][0, pixel], (forward[0] - backward[0]) / 2, rtol=1e-5)
        assert np.allclose(layers["dx_var"][0, pixel], (forward[1] + backward[1]) / 4, rtol=1e-5)
    assert layers["samples"].ravel().tolist() == [16, 64, 32]
    assert GradientStack(layers)["samples"].shape == (1, 3, 1)
