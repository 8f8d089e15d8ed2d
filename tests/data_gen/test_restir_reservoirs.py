"""Reservoirs: weights sum to one, and W is unbiased, in NumPy over paths that can be counted."""

from dataclasses import replace

import numpy as np
import pytest

# Of five paths: light in two pixels, of which the second does not have the last; densities of either's candidates.
LIGHT = np.array([[0.2, 1.5, 0.7, 0.05, 2.0], [0.4, 1.0, 0.1, 0.6, 0.0]])
FOUND = np.array([[0.1, 0.3, 0.2, 0.1, 0.3], [0.25, 0.25, 0.2, 0.3, 0.0]])
# |J| of the shift from the first pixel to the second
JACOBIAN = np.array([0.5, 2.0, 1.0, 1.25, 1.0])
DRAWS = 400


def gray(mi, values):
    return mi.Spectrum(mi.Float(np.asarray(values, np.float32)))


def reservoir(mi, value, W, M, name):
    """A reservoir whose path is known by its number, as the pixel of the record."""
    from data_gen.samplers.restir.record import empty
    from data_gen.samplers.restir.reservoir import Reservoir

    lanes = len(value)
    record = replace(empty(lanes), pixel=mi.UInt32(np.asarray(name, np.uint32)))
    M = mi.Float(np.full(lanes, M, np.float32))
    return Reservoir(record, mi.UInt32(np.zeros(lanes, np.uint32)), gray(mi, value), mi.Float(W), M)


def all_outcomes(mi, M, cap=32.0):
    """The merge of every candidate of the first pixel with every one of the second, of all random numbers.

    Returns the reservoirs and the probability of each. The second pixel's path x is J(x) shorter than the first's: what
    has density p there has p / |J|.
    """
    from data_gen.samplers.restir.reservoir import Seen, merge

    a, b, u = (n.ravel() for n in np.meshgrid(np.arange(5), np.arange(4), (np.arange(DRAWS) + 0.5) / DRAWS))
    # Two candidates lie in two measures, the second's stretched by J.
    here, there = LIGHT[0], LIGHT[1]
    current = reservoir(mi, here[a], 1 / FOUND[0][a], M[0], a)
    previous = reservoir(mi, there[b], 1 / (FOUND[1][b] / JACOBIAN[b]), M[1], b)
    merged = merge(
        current,
        previous,
        Seen(gray(mi, there[a]), mi.Float(JACOBIAN[a])),
        Seen(gray(mi, here[b]), mi.Float(1 / JACOBIAN[b])),
        mi.Float(u),
        cap,
    )
    return merged, FOUND[0][a] * FOUND[1][b] / DRAWS, a, b


@pytest.mark.parametrize("M", [(1, 1), (1, 7), (5, 0.5)])
def test_a_merged_reservoir_is_unbiased(renderer, M):
    """E[value W] is the integral, here the sum over the first pixel's paths."""
    merged, probability, _, _ = all_outcomes(renderer, M)
    estimate = np.array(merged.estimate())[0].astype(float)
    assert np.sum(probability) == pytest.approx(1)
    assert np.sum(probability * estimate) == pytest.approx(LIGHT[0].sum(), rel=2e-3)


@pytest.mark.parametrize("wrong", ["J", "M", "value"])
def test_a_wrong_merge_is_seen_by_that(renderer, monkeypatch, wrong):
    from data_gen.samplers.restir import reservoir as module

    if wrong == "J":
        monkeypatch.setattr(module.Seen, "density", property(lambda seen: renderer.luminance(seen.value)))
    elif wrong == "M":
        monkeypatch.setattr(module, "share", lambda own, others: renderer.Float(0.5))
    else:
        monkeypatch.setattr(module, "weight_of", lambda total, value: total)
    merged, probability, _, _ = all_outcomes(renderer, (1, 7))
    estimate = np.array(merged.estimate())[0].astype(float)
    assert abs(np.sum(probability * estimate) / LIGHT[0].sum() - 1) > 0.02


def test_the_path_that_is_kept_is_the_one_that_is_valued(renderer):
    merged, _, a, b = all_outcomes(renderer, (1, 2))
    name, value = np.array(merged.record.pixel), np.array(merged.value)[0]
    kept = np.array(merged.W) > 0
    assert ((name == a) | (name == b)).all()
    assert np.allclose(value[kept], LIGHT[0][name[kept]])


@pytest.mark.parametrize(("cap", "expected"), [(32, 8), (5, 5), (1, 1)])
def test_confidence_stays_below_its_cap(renderer, cap, expected):
    merged, _, _, _ = all_outcomes(renderer, (1, 7), cap)
    assert (np.array(merged.M) == expected).all()


def test_of_nothing_comes_nothing(renderer):
    """Reservoirs without a path, or with weights that are not finite, add nothing."""
    from data_gen.samplers.restir.reservoir import Seen, merge

    mi = renderer
    for W in (0.0, np.inf, np.nan):
        empty, full = reservoir(mi, [0.0], [W], 9, [1]), reservoir(mi, [2.0], [3.0], 1, [2])
        nothing, all_ = Seen(gray(mi, [0.0]), mi.Float(1)), Seen(gray(mi, [2.0]), mi.Float(1))
        # The full one cannot be found where the empty one is from.
        merged = merge(full, empty, nothing, nothing, mi.Float(0.99), 32)
        assert np.allclose(np.array(merged.estimate()), 6)
        # Nine candidates that have found nothing count as well, where they could have found the path.
        merged = merge(empty, full, nothing, all_, mi.Float(0.0), 32)
        assert np.allclose(np.array(merged.estimate()), 6 / 10)


@pytest.mark.parametrize("others", [1, 2, 5])
def test_pairwise_weights_of_a_path_sum_to_one(renderer, rng, others):
    """p̂ of a path is given in each of the pixels, in the measure of the first; 0 where it cannot be."""
    from data_gen.samplers.restir.reservoir import pairwise, pairwise_other

    mi = renderer
    p = rng.exponential(size=(others + 1, 50)).astype(np.float32)
    p[1:][rng.random((others, 50)) < 0.3] = 0
    M = rng.uniform(0.5, 20, size=(others + 1, 50)).astype(np.float32)
    pairs = [(mi.Float(c), mi.Float(q)) for c, q in zip(M[1:], p[1:], strict=True)]
    rest = mi.Float(M[1:].sum(axis=0))
    total = np.array(pairwise(mi.Float(M[0]), mi.Float(p[0]), pairs))
    expected = M[0] / M.sum(axis=0)
    for (c, q), row, weight in zip(pairs, p[1:], M[1:], strict=True):
        total = total + np.array(pairwise_other(c, q, mi.Float(M[0]), mi.Float(p[0]), rest))
        others_sum = M[1:].sum(axis=0)
        expected = expected + weight / M.sum(axis=0) * (M[0] * p[0] / (M[0] * p[0] + others_sum * row))
    assert np.allclose(total, 1, atol=1e-5)
    own = np.array(pairwise(mi.Float(M[0]), mi.Float(p[0]), pairs))
    assert np.allclose(own, expected, rtol=1e-4)


def test_a_difference_counts_each_path_once(renderer, rng):
    """From both sides of a pair, a path's weights add up to "second - first"."""
    from data_gen.samplers.restir.reservoir import difference

    mi = renderer
    a, b = (rng.exponential(size=(3, 40)).astype(np.float32) for _ in range(2))
    b[:, :10] = 0
    a[:, 10:15] = 0
    first, second = mi.Spectrum(a), mi.Spectrum(b)
    sides = [difference(first, second, mi.UInt32(side)) for side in (0, 1)]
    assert np.allclose(np.array(sides[0] + sides[1]), b - a, atol=1e-5)
    # What only the first pixel can see, only the first can sample.
    assert np.allclose(np.array(sides[0])[:, :10], -a[:, :10])


def test_a_difference_is_its_positive_less_its_negative_part(renderer, rng):
    from data_gen.samplers.restir.reservoir import part

    values = rng.normal(size=(3, 30)).astype(np.float32)
    parts = [np.array(part(renderer.Spectrum(values), sign)) for sign in (1, -1)]
    assert all((p >= 0).all() for p in parts)
    assert np.array_equal(parts[0] - parts[1], values)
