"""wcv over frames: the known answers, and what it is without differences in time."""

import numpy as np
import pytest

from ngpt.classical.controlvariates import wcv
from ngpt.classical.gradients import forward_differences
from ngpt.sequence.warp import bilinear_taps, warped
from ngpt.sequence.wcv_frames import Link, WindowFrame, wcv_frames

SIZE = (12, 16, 3)


def frame(image, noise, rng, link=None, spread=1.0, trusted=None):
    """A frame of an image with that much noise, and none in its differences."""
    dx, dy = forward_differences(image)
    variances = np.full(SIZE, noise**2), np.full(SIZE, spread), np.full(SIZE, spread)
    noisy = image + noise * rng.normal(size=SIZE)
    return WindowFrame(noisy, np.zeros(SIZE), dx, dy, variances, trusted, noisy, link)


def link(now, before, motion, variance=1e-6, noise=0.0, rng=None):
    there, found = warped(before, motion)
    dt = np.where(found[..., None], now - there, np.nan)
    if noise:
        dt = dt + noise * rng.normal(size=SIZE)
    return Link(motion, dt, np.full(SIZE, variance))


def error(results, truth):
    return np.mean([np.square(result - image).mean() for result, image in zip(results, truth, strict=True)])


def test_without_differences_in_time_it_is_wcv(rng):
    image = rng.random(SIZE)
    stills = [frame(image, 0.3, rng, spread=0.01) for _ in range(2)]
    unknown = Link(np.zeros((*SIZE[:2], 2)), np.full(SIZE, np.nan), np.full(SIZE, np.nan))
    trusted = rng.random(SIZE[:2]) > 0.1, rng.random(SIZE[:2]) > 0.1
    for f in (stills[0], frame(image, 0.3, rng, spread=0.01, trusted=trusted)):
        expected = wcv(*(a.astype(float) for a in (f.image, f.dx, f.dy, *f.variances)), f.trusted)
        assert np.allclose(wcv_frames([f])[0], expected, atol=1e-5)
    pair = [stills[0], frame(image, 0.3, rng, unknown, spread=0.01)]
    assert np.allclose(wcv_frames(pair)[0], wcv_frames([stills[0], stills[1]])[0], atol=1e-6)


@pytest.mark.parametrize(("motion", "share"), [((0.0, 0.0), 0.35), ((2.0, -1.0), 0.55), ((0.3, 0.6), 0.55)])
def test_frames_share_what_they_know(rng, motion, share):
    """Light that changes by what dt says: the noise of a frame falls with their number, and nothing is biased."""
    truth = [rng.random(SIZE) + t for t in range(6)]
    moved = np.broadcast_to(motion, (*SIZE[:2], 2))
    noise = [0.3 * rng.normal(size=SIZE) for _ in truth]

    def results(linked):
        found = []
        for t, image in enumerate(truth):
            known = link(image, truth[t - 1], moved) if t and linked else None
            one = frame(image, 0.3, rng, known, spread=100.0)
            noisy = image + noise[t]
            # A first guess without noise has what interpolation does not know.
            found.append(WindowFrame(noisy, one.apart, one.dx, one.dy, one.variances, None, np.zeros(SIZE), known))
        return wcv_frames(found)

    alone, together = error(results(False), truth), error(results(True), truth)
    assert together < share * alone


def test_noisy_differences_in_time_count_little(rng):
    truth = [np.ones(SIZE) * (1 + t) for t in range(5)]
    still = np.zeros((*SIZE[:2], 2))
    spread = [frame(image, 0.1, rng, spread=0.01) for image in truth]
    bad = [
        frame(image, 0.1, rng, link(image, truth[t - 1], still, 4.0, 2.0, rng) if t else None, spread=0.01)
        for t, image in enumerate(truth)
    ]
    assert error(wcv_frames(bad), truth) < 1.3 * error(wcv_frames(spread), truth)


def test_taps_are_those_of_the_bilinear_image(rng):
    image, motion = rng.random(SIZE), rng.uniform(-4, 4, (*SIZE[:2], 2))
    motion[2, 3] = np.nan
    places, weights, found = bilinear_taps(motion, SIZE[:2])
    value = (image.reshape(-1, 3)[places] * weights[..., None]).sum(axis=0).reshape(SIZE)
    assert not found[2, 3] and np.allclose(value[found], warped(image, motion)[0][found])
