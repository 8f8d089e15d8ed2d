"""How much of history is taken: what is of least squared error against a truth that the rules do not know."""

import numpy as np
import pytest

from ngpt.sequence.evidence import weighed

SIGMA, SIZE = 0.2, (64, 80, 3)


def blocks(image, n):
    """Means over blocks of n x n pixels: of a smooth image, a method that leaves 1/n² of the noise."""
    means = image.reshape(SIZE[0] // n, n, SIZE[1] // n, n, 3).mean(axis=(1, 3))
    return means.repeat(n, axis=0).repeat(n, axis=1)


def seen(rng, n, history):
    """Pixels p, results x and history h of a grey wall: h is the truth, or has noise of its own."""
    p, other = (SIGMA * rng.normal(size=SIZE) for _ in range(2))
    return p + 1, blocks(p, n) + 1, 1 + history * blocks(other, n)


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("history", [0.0, 0.5, 1.0])
def test_the_share_of_history_is_of_least_error(rng, n, history):
    p, x, h = seen(rng, n, history)
    everywhere = np.ones(SIZE[:2])
    best = weighed(x, h, p, np.full(SIZE, SIGMA**2), everywhere, everywhere).best
    truth = ((h - x) * (1 - x)).sum() / np.square(h - x).sum()
    assert np.mean(best) == pytest.approx(truth, abs=0.1)


def test_what_came_into_sight_says_nothing_of_the_noise_that_is_left_elsewhere(rng):
    """In most of the image, which has no history, the method took nothing off; elsewhere all of it."""
    p, x, h = seen(rng, 2, 0.0)
    trust = np.ones(SIZE[:2])
    trust[:, :48], x[:, :48] = 0, p[:, :48]
    best = weighed(x, h, p, np.full(SIZE, SIGMA**2), trust, np.ones(SIZE[:2])).best[:, 60:]
    assert np.mean(best) == pytest.approx(1, abs=0.3)
