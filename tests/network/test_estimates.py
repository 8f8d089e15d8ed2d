"""Variances that a stack lacks: estimated where networks of gradients need them, left alone where they are known."""

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.denoisers import oidn
from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.network import inputs
from ngpt.network.estimates import with_variances
from ngpt.repair import repair
from ngpt.stack import GradientStack

VARIANCES = ("primal_var", "dx_var", "dy_var")


def without(stack, *names):
    return GradientStack({name: layer for name, layer in stack.layers.items() if name not in names})


@pytest.fixture
def noisy(rng):
    """A stack without variances whose noise is known, twice as strong on the right; and the image without it."""
    y, x = np.mgrid[0:60, 0:80] / 12
    clean = np.stack([2 + np.sin(x + c) * np.cos(y) for c in range(3)], axis=-1)
    strong = np.where(np.arange(80) < 40, 1.0, 2.0)[None, :, None]
    dx, dy = (g + 0.02 * strong * rng.normal(size=g.shape) for g in forward_differences(clean))
    return GradientStack.from_arrays(primal=clean + 0.2 * strong * rng.normal(size=clean.shape), dx=dx, dy=dy), clean


def test_the_estimate_is_the_variance_where_the_image_is_right(noisy):
    stack, clean = noisy
    data = with_variances(repair(stack), clean.astype(np.float32))
    for variance, deviation in zip(data.variances, (0.2, 0.02, 0.02), strict=True):
        assert variance.shape == clean.shape and variance.dtype == np.float32
        assert variance[5:-5, 5:35].mean() == pytest.approx(deviation**2, rel=0.15)
        assert variance[5:-5, 45:-5].mean() == pytest.approx(4 * deviation**2, rel=0.15)
    assert np.array_equal(data.noise, data.variances[0])


def test_known_variances_stay(noisy):
    stack, clean = noisy
    data = repair(stack.replace(primal_var=np.full_like(stack["primal"], 7)))
    assert (with_variances(data, clean).variances[0] == 7).all()
    whole = repair(full_stack(9, 8))
    assert all(a is b for a, b in zip(with_variances(whole, whole.image).variances, whole.variances, strict=True))


def test_nothing_is_known_of_what_is_not_trusted_and_of_lamps(noisy):
    stack, clean = noisy
    dx, direct = stack["dx"].copy(), np.zeros_like(stack["primal"])
    dx[3, 4], direct[10, 11] = np.nan, 50
    data = with_variances(repair(stack.replace(dx=dx, direct=direct, primal=stack["primal"] + direct)), clean)
    noise, of_dx, of_dy = data.variances
    assert np.isnan(noise[10, 11]).all() and np.isfinite(noise).sum() == noise.size - 3
    assert np.isnan(of_dx[3, 4]).all() and np.isfinite(of_dx).sum() == of_dx.size - 3 and np.isfinite(of_dy).all()


@pytest.mark.parametrize("name", ["ngpt-fast", "ngpt-combine"])
def test_networks_run_without_variances_and_say_so(name, tmp_path):
    if ngpt.METHODS[name].missing():
        pytest.skip(ngpt.METHODS[name].missing())
    stack = full_stack(30, 34)
    for absent, told in ((VARIANCES, VARIANCES), (("dy_var",), ("dx_var", "dy_var")), (("primal_var",), VARIANCES)):
        result = ngpt.reconstruct(without(stack, *absent), name)
        assert result.estimated == told and np.isfinite(result.image).all()
        assert result.attributes["ngpt:estimated"] == ", ".join(told)
    result = ngpt.reconstruct(stack, name)
    assert result.estimated == () and "ngpt:estimated" not in result.attributes


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
@pytest.mark.parametrize("noise", [None, 0.0, 1.0, -1.0, "0"])
@pytest.mark.parametrize("absent", [(), VARIANCES])
def test_features_are_filtered_once_for_a_frame_if_they_are_noisy(absent, noise, monkeypatch):
    calls = []
    real = inputs.prefiltered
    monkeypatch.setattr(inputs, "prefiltered", lambda *given: calls.append(1) or real(*given))
    for name in ("ngpt-combine", "ngpt-primal") if not absent else ("ngpt-combine",):
        calls.clear()
        stack = without(full_stack(24, 28), *absent)
        if noise is not None:
            stack.attributes[FEATURE_NOISE] = noise
        ngpt.denoise(stack, name)
        assert calls == ([] if noise == 0 else [1]), name


def test_training_never_reads_estimates():
    with pytest.raises(NgptError, match="need layers primal_var, dx_var, dy_var"):
        inputs.gather(repair(without(full_stack(6, 5), *VARIANCES)), ("primal", "base"), "wcv")
