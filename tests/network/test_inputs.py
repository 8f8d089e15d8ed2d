"""What networks read of a stack: the same for both runtimes; what it lacks is estimated, or refused by name."""

import numpy as np
import pytest
from full_stack import full_stack
from shots import without

import ngpt
from ngpt.classical.bases import BASES
from ngpt.classical.energy import keep_energy
from ngpt.classical.gradients import forward_differences
from ngpt.denoisers import oidn
from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.methods import METHODS, reconstruct
from ngpt.network import inputs
from ngpt.network.estimates import with_variances
from ngpt.repair import repair
from ngpt.stack import GradientStack

VARIANCES = ("primal_var", "dx_var", "dy_var")


@pytest.mark.parametrize("base", BASES)
def test_a_base_is_what_the_method_of_that_name_makes(base):
    """But for the energy that wcv gives back, which a tile does not know."""
    stack = full_stack(12, 17)
    data = repair(stack)
    made = inputs.base_image(data, base)
    if base == "wcv":
        made = keep_energy(made, data.image)
    assert np.array_equal(made, reconstruct(stack, base).image)
    assert BASES[base].needs == METHODS[base].needs == inputs.needs(("primal", "base"), base)


def test_standard_errors_are_roots_and_0_where_nothing_is_known_in_the_order_asked_for():
    stack = full_stack(9, 8)
    variance = stack["primal_var"].copy()
    variance[1, 2], variance[3, 4, 0], variance[5, 6, 1] = np.nan, -1, np.inf
    data = repair(stack.replace(primal_var=variance))
    given = inputs.gather(data, ("depth", "primal_se", "base", "primal_var"), "cv")
    assert list(given) == ["depth", "primal_se", "base", "primal_var"]
    assert np.array_equal(given["primal_var"], variance, equal_nan=True)
    known = np.isfinite(variance) & (variance >= 0)
    assert np.array_equal(given["primal_se"], np.where(known, np.sqrt(np.where(known, variance, 0)), 0))


@pytest.mark.parametrize(
    ("absent", "names", "base", "message"),
    [
        (("dx", "dy", *VARIANCES[1:]), ("primal", "dx", "dy_se"), "", "the file need layers dx, dy_var, which the sta"),
        (("dx", "dy", *VARIANCES[1:]), ("base",), "cv", "need layers dx, dy, which"),
        (("dx_var",), ("base",), "wcv", "need layers dx_var, dy_var, which"),
        # Training never reads estimates.
        (VARIANCES, ("primal", "base"), "wcv", "need layers primal_var, dx_var, dy_var"),
        (("albedo",), ("denoised",), "", "need layers albedo, which"),
        ((), ("primal", "denoised_base"), "", "need layers base, which"),
        ((), ("primal", "colour"), "", "need layers colour, which"),
    ],
)
def test_what_is_lacking_is_named(absent, names, base, message):
    with pytest.raises(NgptError, match=message):
        inputs.gather(repair(without(full_stack(6, 5), *absent)), names, base, "the file")


@pytest.fixture
def noisy(rng):
    """A stack without variances whose noise is known, twice as strong on the right; and the image without it."""
    y, x = np.mgrid[0:60, 0:80] / 12
    clean = np.stack([2 + np.sin(x + c) * np.cos(y) for c in range(3)], axis=-1)
    strong = np.where(np.arange(80) < 40, 1.0, 2.0)[None, :, None]
    dx, dy = (g + 0.02 * strong * rng.normal(size=g.shape) for g in forward_differences(clean))
    return GradientStack.from_arrays(primal=clean + 0.2 * strong * rng.normal(size=clean.shape), dx=dx, dy=dy), clean


def test_an_estimate_is_the_variance_where_the_image_is_right(noisy):
    stack, clean = noisy
    data = with_variances(repair(stack), clean.astype(np.float32))
    for variance, deviation in zip(data.variances, (0.2, 0.02, 0.02), strict=True):
        assert variance.shape == clean.shape and variance.dtype == np.float32
        assert variance[5:-5, 5:35].mean() == pytest.approx(deviation**2, rel=0.15)
        assert variance[5:-5, 45:-5].mean() == pytest.approx(4 * deviation**2, rel=0.15)
    assert np.array_equal(data.noise, data.variances[0])
    known = repair(stack.replace(primal_var=np.full_like(stack["primal"], 7)))
    assert (with_variances(known, clean).variances[0] == 7).all()


def test_nothing_is_known_of_what_is_not_trusted_and_of_lamps(noisy):
    stack, clean = noisy
    dx, direct = stack["dx"].copy(), np.zeros_like(stack["primal"])
    dx[3, 4], direct[10, 11] = np.nan, 50
    data = with_variances(repair(stack.replace(dx=dx, direct=direct, primal=stack["primal"] + direct)), clean)
    noise, of_dx, of_dy = data.variances
    assert np.isnan(noise[10, 11]).all() and np.isfinite(noise).sum() == noise.size - 3
    assert np.isnan(of_dx[3, 4]).all() and np.isfinite(of_dx).sum() == of_dx.size - 3 and np.isfinite(of_dy).all()


@pytest.mark.parametrize(
    ("absent", "told"),
    [((), ()), (VARIANCES, VARIANCES), (("dy_var",), ("dx_var", "dy_var")), (("primal_var",), VARIANCES)],
)
def test_networks_run_without_variances_and_say_so(absent, told):
    result = ngpt.reconstruct(without(full_stack(30, 34), *absent), "ngpt-fast")
    assert result.estimated == told and np.isfinite(result.image).all()
    assert result.attributes.get("ngpt:estimated", "") == ", ".join(told)


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
@pytest.mark.parametrize("noise", [None, 0.0, 1.0, "0"])
def test_features_are_filtered_once_for_a_frame_if_they_are_noisy(noise, monkeypatch):
    calls, real = [], inputs.with_clean_features
    monkeypatch.setattr(inputs, "with_clean_features", lambda *given: calls.append(1) or real(*given))
    stack = without(full_stack(24, 28), *VARIANCES)
    if noise is not None:
        stack.attributes[FEATURE_NOISE] = noise
    ngpt.denoise(stack, "ngpt-combine")
    assert calls == ([] if noise == 0 else [1])
