"""Flicker where it is known."""

import numpy as np

from ngpt.measure.flicker import change_maps, flicker
from ngpt.measure.metrics import relmse_trimmed

REST = np.zeros((30, 40, 2))


def test_errors_that_stay_are_no_flicker(rng):
    truth = [rng.random((30, 40, 3)) for _ in range(3)]
    wrong = rng.random((30, 40, 3))
    assert flicker([t + wrong for t in truth], truth, [REST] * 3) < 1e-20


def test_independent_errors_flicker_with_twice_their_square(rng):
    truth = [np.ones((30, 40, 3))] * 6
    images = [t + rng.normal(0, 0.1, t.shape) for t in truth]
    error = np.mean([relmse_trimmed(i, t) for i, t in zip(images, truth, strict=True)])
    assert np.isclose(flicker(images, truth, [REST] * 6), 2 * error, rtol=0.1)


def test_what_is_not_known_does_not_count(rng):
    truth = [np.ones((30, 40, 3))] * 2
    images = [truth[0], truth[0] * 2]
    motion = np.full((30, 40, 2), np.nan)
    assert np.isnan(flicker(images, truth, [None, motion])) and np.isnan(flicker(images, truth, [None, None]))
    motion[3, 3] = 0
    assert np.isclose(flicker(images, truth, [None, motion]), 1 / 1.001)


def test_the_map_of_change_is_along_motion(rng):
    wide = rng.random((30, 46, 3))
    images = [wide[:, i : i + 40] for i in range(2)]
    along = change_maps(images, [None, REST + np.array([1, 0])])[0]
    assert np.isnan(along[:, -1]).all() and np.abs(along[:, :-1]).max() < 1e-20
    assert np.isclose(change_maps([REST, REST + 2], [None, None])[0], 4 / 2.001).all()
