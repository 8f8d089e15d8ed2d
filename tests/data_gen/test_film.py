"""The film's statistics against NumPy's on all samples at once."""

import math

import numpy as np
import pytest

pytest.importorskip("mitsuba")

import data_gen.film.gradient_film as module
from data_gen.film import GradientFilm as film
from data_gen.film.nets import split
from data_gen.film.statistics import contrast


def fill(mi, film, samples, **kwargs):
    """``samples``: (pixels, spp, 3), put as lanes ordered pixel by pixel."""
    film.put("primal", mi.Color3f(*samples.reshape(-1, 3).T.astype(np.float32)), **kwargs)


def test_mean_and_variance_over_passes_of_different_size(renderer, rng):
    """In float64: constant samples keep their value and have no variance, however many they are."""
    samples = (1000 + rng.normal(size=(6, 7, 3))).astype(np.float32)  # mean large beside the deviation
    whole = film(3, 2)
    fill(renderer, whole, samples[:, :4])
    fill(renderer, whole, samples[:, 4:5])
    fill(renderer, whole, samples[:, 5:])
    layers = whole.develop()
    assert np.allclose(layers["primal"].reshape(6, 3), samples.mean(axis=1), rtol=1e-6)
    expected = samples.astype(np.float64).var(axis=1, ddof=1) / 7
    assert np.allclose(layers["primal_var"].reshape(6, 3), expected, rtol=1e-3)
    constant = film(1, 1)
    for _ in range(50):
        fill(renderer, constant, np.full((1, 1000, 3), 0.1))
    layers = constant.develop()
    assert (layers["primal"] == np.float32(0.1)).all() and not layers["primal_var"].any()


def test_nonfinite_samples_have_no_weight_and_are_counted(renderer, rng):
    samples = rng.random((4, 5, 3)).astype(np.float32)
    spoiled = samples.copy()
    spoiled[0, 2, 1], spoiled[3, 0, 0], spoiled[1] = np.nan, -np.inf, np.inf
    target = film(2, 2)
    fill(renderer, target, spoiled)
    layer = target.develop()["primal"].reshape(4, 3)
    assert target.discarded == 1 + 1 + 5
    assert np.allclose(layer[0], np.delete(samples[0], 2, axis=0).mean(axis=0))
    assert np.allclose(layer[2], samples[2].mean(axis=0))
    assert np.isnan(layer[1]).all()  # nothing is known about it, which must not look like black


def test_gradients_are_half_of_each_direction(renderer, rng):
    """Forward from a pixel, and backward from the next one; their variances are variances of the means."""
    target, names = film(4, 3), ("dx+", "dx-", "dy+", "dy-")
    fill(renderer, target, np.zeros((12, 8, 3)))
    samples = {name: rng.normal(size=(3, 4, 8)).astype(np.float32) for name in names}
    for name, values in samples.items():
        target.put(name, renderer.Color3f(renderer.Float(values.ravel())))
    mean = {name: values.mean(axis=-1) for name, values in samples.items()}
    variance = {name: values.var(axis=-1, ddof=1) / 8 for name, values in samples.items()}
    layers = {name: layer[..., 0] for name, layer in target.develop().items()}
    for name, here, there in (("dx", np.s_[:, :-1], np.s_[:, 1:]), ("dy", np.s_[:-1], np.s_[1:])):
        forward, backward = f"{name}+", f"{name}-"
        assert np.allclose(layers[name][here], (mean[forward][here] - mean[backward][there]) / 2, atol=1e-6)
        assert np.allclose(layers[f"{name}_var"][here], (variance[forward][here] + variance[backward][there]) / 4)
    assert not layers["dx"][:, -1].any() and not layers["dy"][-1].any()


@pytest.mark.parametrize("strands", [1, 6 * 5])
def test_feature_noise_is_that_of_the_noisier_feature(renderer, rng, strands, monkeypatch):
    monkeypatch.setattr(module, "_STRANDS", strands)
    target = film(3, 2)
    assert target.feature_noise is None
    features = {"albedo": rng.random((6, 8, 3)), "normal": 3 * rng.random((6, 8, 3)), "depth": 9 * rng.random((6, 8))}
    for first, last in ((0, 1), (1, 8)):
        fill(renderer, target, np.zeros((6, last - first, 3)))
        for name, samples in features.items():
            part = samples[:, first:last].astype(np.float32)
            colour = part.ndim == 3
            target.put(name, renderer.Color3f(*part.reshape(-1, 3).T) if colour else renderer.Float(part.ravel()))
        target.end_pass()
        if last == 1:
            assert target.feature_noise is None
    expected = [features[name].var(axis=1, ddof=1).mean() / 8 for name in ("albedo", "normal")]
    assert target.feature_noise == pytest.approx(max(expected), rel=1e-4)
    assert not {"albedo_var", "normal_var"} & set(target.develop())
    monkeypatch.setattr(module, "_ENOUGH", 3)
    some = features["normal"][::2].var(axis=1, ddof=1).mean() / 8
    assert target.feature_noise == pytest.approx(some, rel=1e-4)


def test_diagnostics_are_images_beside_the_layers(renderer, rng):
    mi = renderer
    target = film(2, 2)
    for _ in range(2):
        samples = rng.random((4, 8, 3)).astype(np.float32)
        samples[3, :2] = np.nan
        fill(mi, target, samples)
        target.put("shift_failures", mi.Float(np.repeat([0, 0.25, 0.5, 1], 8).astype(np.float32)))
    assert set(target.develop()) == {"primal", "primal_var"}
    images = target.diagnose()
    assert images["diagnostics.shiftFailures"].tolist() == [[0, 0.25], [0.5, 1]]
    # A share of all values: 2 of 8 colours, and none of 8 rates.
    assert images["diagnostics.discarded"].tolist() == [[0, 0], [0, 0.125]]


def test_blocks_and_strands_lose_no_sample(renderer, rng, monkeypatch):
    samples = rng.random((6, 40, 3)).astype(np.float32)
    results = []
    for strands in (1, 6 * 3, 6 * 64):
        monkeypatch.setattr(module, "_STRANDS", strands)
        target = film(3, 2)
        for first, last in ((0, 16), (16, 40)):  # a block of 16, then three of 8
            part = samples[:, first:last]
            block = 16 if first == 0 else 8
            lanes = part.reshape(6, -1, block, 3).swapaxes(0, 1).reshape(-1, 3)
            target.put("primal", renderer.Color3f(*lanes.T))
            target.end_pass(block)
        assert target.samples == 40
        results.append(target.develop())
    for layers in results:
        assert np.allclose(layers["primal"].reshape(6, 3), samples.mean(axis=1), rtol=1e-6)
        assert np.allclose(layers["primal_var"].reshape(6, 3), samples.var(axis=1, ddof=1) / 40, rtol=1e-5)


def test_splats_add_up_in_any_order(renderer, rng):
    """Values over 16 orders of magnitude, to the last bit; those that are not finite are counted where they fell."""
    mi, n = renderer, 20000
    pixel = rng.integers(0, 6, n).astype(np.uint32)
    value = (rng.normal(size=(3, n)) * 10.0 ** rng.uniform(-8, 8, n)).astype(np.float32)
    value[1, 7], value[2, 9] = np.nan, np.inf
    good = np.isfinite(value).all(axis=0)
    results = []
    for order in (np.arange(n), rng.permutation(n)):
        target = film(3, 2, batches=True)
        target.splat("primal", mi.UInt32(pixel[order]), mi.Color3f(*value[:, order]))
        target.end_pass(4)
        results.append(target.develop()["primal"].reshape(6, 3))
        assert target.samples == 4 and target.discarded == 2
        assert target.diagnose()["diagnostics.discarded"].ravel()[pixel[7]] > 0
    assert np.array_equal(*results)
    exact = [[math.fsum(row[good & (pixel == i)].astype(float)) / 4 for row in value] for i in range(6)]
    assert np.array_equal(results[0], np.array(exact, np.float32))


def test_batches_have_the_variance_of_their_means(renderer, rng):
    """Samples of a pass that share their error: over samples the variance would be far too small."""
    mi = renderer
    shared = rng.normal(size=(24, 1, 1, 3))
    samples = (shared + 0.1 * rng.normal(size=(24, 6, 8, 3))).astype(np.float32)
    samples[3, 2, 5] = np.nan
    target = film(3, 2, batches=True)
    for batch in samples:
        fill(mi, target, batch)
        target.end_pass(8)
    means = np.nanmean(samples.astype(np.float64), axis=2)
    layers = target.develop()
    assert target.samples == 24 * 8 and target.discarded == 1
    assert np.allclose(layers["primal"].reshape(6, 3), means.mean(axis=0), rtol=1e-6)
    assert np.allclose(layers["primal_var"].reshape(6, 3), means.var(axis=0, ddof=1) / 24, rtol=1e-6)


def test_a_last_batch_with_fewer_samples_counts_for_less(renderer, rng):
    """Eight, eight and one samples: the mean is over all 17, and its variance as for independent ones."""
    samples = rng.normal(size=(2400, 17, 3)).astype(np.float32)
    target = film(60, 40, batches=True)
    for part in np.split(samples, (8, 16), axis=1):
        fill(renderer, target, part)
        target.end_pass(part.shape[1])
    layers = target.develop()
    assert np.allclose(layers["primal"].reshape(-1, 3), samples.mean(axis=1), rtol=1e-4, atol=1e-6)
    assert layers["primal_var"].mean() == pytest.approx(1 / 17, rel=0.1)
    assert np.square(layers["primal"]).mean() == pytest.approx(1 / 17, rel=0.1)
    with pytest.raises(ValueError, match="only the last may be smaller"):
        fill(renderer, target, np.zeros((2400, 9, 3), np.float32))
        target.end_pass(9)


def test_what_is_put_and_what_is_splatted_are_one_value(renderer):
    mi = renderer
    target = film(2, 1, batches=True)
    for scale in (1, 3):
        # Two samples a pixel; the second pixel's are all lost, so that nothing is known of it in this pass.
        lost = np.nan if scale == 3 else 8
        target.put("primal", mi.Color3f(mi.Float(np.array([scale, 3 * scale, lost, lost], np.float32))))
        for pixel in (0, 0, 1):
            target.splat("primal", mi.UInt32([pixel]), mi.Color3f(mi.Float([4.0 * scale])))
        target.end_pass(2)
    image = target.develop()["primal"][0, :, 0]
    with pytest.raises(ValueError, match="make the film with batches"):
        film(2, 1).splat("primal", mi.UInt32([0]), mi.Color3f(1))
    # (1 + 3) / 2 + (4 + 4) / 2 = 6, and three times that; 8 + 4 / 2 = 10, once.
    assert image.tolist() == [(6 + 18) / 2, 10]


@pytest.mark.parametrize("strands", [1, 2, 5])
def test_contrasts_are_of_the_first_samples_and_those_behind_them(renderer, rng, strands, monkeypatch):
    """Whichever strands these are in; a strand may have none between two powers of two."""
    monkeypatch.setattr(module, "_STRANDS", 6 * strands)
    samples = rng.normal(size=(6, 160, 3)).astype(np.float32)
    target = film(3, 2, net=16)
    for n in range(16, 161, 16):
        fill(renderer, target, samples[:, n - 16 : n])
        target.end_pass()
        n1, n2 = split(n), n - split(n)
        later, earlier = samples[:, n1:n].mean(axis=1), samples[:, :n1].mean(axis=1)
        found = contrast(target.moments["primal"], strands, np.full(6, n))
        assert np.allclose(found, (later - earlier) * math.sqrt(n1 * n2) / n, atol=1e-6), n
