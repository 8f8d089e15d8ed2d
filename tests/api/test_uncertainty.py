"""The standard error of a reconstruction: what it says of noise, of scale, and of what a stack must hold."""

from dataclasses import replace

import numpy as np
import pytest

import ngpt
from ngpt.api.uncertainty import FACTORS, noisier
from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window


@pytest.fixture
def stack(rng):
    """Noise of 0.1 on the left, of 0.4 on the right, on a grey image, 48x32; gradients with a tenth of it."""
    noise = np.full((32, 48, 3), 0.1)
    noise[:, 24:] = 0.4
    primal = 1 + noise * rng.standard_normal(noise.shape)
    dx, dy = (0.1 * noise * rng.standard_normal(noise.shape) for _ in range(2))
    variances = {"primal_var": noise**2, "dx_var": (0.1 * noise) ** 2, "dy_var": (0.1 * noise) ** 2}
    return GradientStack.from_arrays(primal=primal, dx=dx, dy=dy, **variances)


def test_the_error_of_an_image_as_it_is_is_its_noise(stack):
    result = ngpt.reconstruct_with_error(stack, "primal")
    assert np.array_equal(result.image, ngpt.denoise(stack, "primal"))
    expected = FACTORS["primal"] * np.sqrt(stack["primal_var"])
    assert result.error.shape == result.image.shape and result.error.dtype == np.float32
    for side in (np.s_[:, :18], np.s_[:, 30:]):
        assert np.mean(result.error[side]) == pytest.approx(np.mean(expected[side]), rel=0.05)


def test_halves_show_a_blotch_that_variances_do_not(stack, rng):
    """A bright spot over several pixels in one half only, whose variance nobody has seen."""
    spot = np.zeros_like(stack["primal"])
    spot[10:14, 8:12] = 4.0
    one, other = stack.replace(primal=stack["primal"] + spot), stack
    merged = stack.replace(primal=stack["primal"] + spot / 2)
    without, with_halves = (
        ngpt.reconstruct_with_error(merged, "wcv", halves=halves).error for halves in (None, (one, other))
    )
    blotch = np.s_[10:14, 8:12]
    true = np.abs(ngpt.denoise(merged, "wcv") - ngpt.denoise(stack, "wcv"))[blotch]
    assert np.mean(without[blotch] < true / 5) > 0.3
    assert np.mean(with_halves[blotch] < true / 5) == 0
    with pytest.raises(NgptError, match=r"half of the samples is 20x32 and the stack 48x32"):
        small = GradientStack({name: stack[name][:, :20] for name in stack.names})
        ngpt.reconstruct_with_error(merged, "wcv", halves=(small, other))


def test_halves_are_of_one_place_and_of_different_seeds(stack):
    def half(seed, left=0):
        place = Place(Window(left, 0, 48, 32), Window(0, 0, 96, 32))
        return replace(stack, attributes={"ngpt:seed": seed}, place=place)

    whole = half("1 2 3")
    assert ngpt.reconstruct_with_error(whole, "wcv", halves=(half("1"), half("2 3"))).error is not None
    with pytest.raises(NgptError, match=r"48x32 at \(48, 0\) .* and the stack 48x32 at \(0, 0\)"):
        ngpt.reconstruct_with_error(whole, "wcv", halves=(half("1"), half("2", left=48)))
    with pytest.raises(NgptError, match="both halves have seed 2"):
        ngpt.reconstruct_with_error(whole, "wcv", halves=(half("1 2"), half("2 3")))


def test_without_noise_there_is_none(stack):
    silent = stack.replace(**{name: 0 * stack[name] for name in ("primal_var", "dx_var", "dy_var")})
    assert not ngpt.reconstruct_with_error(silent, "wcv").error.any()


def test_of_variances_that_are_not_finite_the_error_is_not_known(stack):
    variance, of_dx = stack["primal_var"].copy(), stack["dx_var"].copy()
    variance[3, 4], variance[5, 6], of_dx[7, 8], of_dx[:, -1] = np.nan, np.inf, np.nan, np.nan
    holes = stack.replace(primal_var=variance, dx_var=of_dx)
    noisy = noisier(holes)
    assert np.array_equal(noisy["primal"][[3, 5], [4, 6]], stack["primal"][[3, 5], [4, 6]])
    error = ngpt.reconstruct_with_error(holes, "wcv").error
    assert [tuple(place) for place in np.argwhere(np.isnan(error).any(axis=-1))] == [(3, 4), (5, 6), (7, 8)]
    whole = ngpt.reconstruct_with_error(stack, "wcv").error
    assert np.nanmax(np.abs(error - whole)[9:, 12:] / whole[9:, 12:]) < 0.02
    nothing = stack.replace(primal_var=np.full_like(variance, np.nan))
    assert np.isnan(ngpt.reconstruct_with_error(nothing, "l1").error).all()


def test_the_light_apart_is_part_of_the_primal(stack, rng):
    light = np.abs(rng.standard_normal(stack["primal"].shape)).astype(np.float32)
    with_light = stack.replace(caustic=light, caustic_var=0.01 * light, primal=stack["primal"] + light)
    noisy = noisier(with_light)
    # Of one draw: what is added to the rest is what is added to a stack without such light.
    rest = noisy["primal"] - noisy["caustic"]
    assert np.allclose(rest, noisier(stack)["primal"], atol=1e-5)
    assert np.var(noisy["caustic"] - light) == pytest.approx(np.mean(0.01 * light), rel=0.1)


def test_stacks_without_variances_are_refused(stack):
    colour = GradientStack.from_arrays(primal=stack["primal"])
    with pytest.raises(NgptError, match=r"an estimate of the error needs layer 'primal_var'.*several seeds"):
        ngpt.reconstruct_with_error(colour)
    some = {name: stack[name] for name in stack.names if name != "dy_var"}
    with pytest.raises(NgptError, match="what gradients give needs layer 'dy_var'"):
        ngpt.reconstruct_with_error(GradientStack(some))


def test_the_command_writes_the_layer(stack, tmp_path, command):
    ngpt.write(tmp_path / "stack.exr", stack)
    command("denoise stack.exr -o out.exr -m wcv --error")
    expected = ngpt.reconstruct_with_error(stack, "wcv")
    assert np.array_equal(ngpt.read("out.exr")["error"], expected.error)
    assert np.array_equal(ngpt.read_image("out.exr"), expected.image)
    # It is no part of a result of the result.
    command("denoise out.exr -o again.exr -m l2")
    assert "error" not in ngpt.read("again.exr")


def test_the_command_takes_halves(stack, tmp_path, rng, command):
    halves = [stack.replace(primal=stack["primal"] + 0.2 * rng.standard_normal((32, 48, 3))) for _ in range(2)]
    for name, one in zip(("stack", "a", "b"), (stack, *halves), strict=True):
        ngpt.write(tmp_path / f"{name}.exr", one)
    command("denoise stack.exr -m wcv --halves a.exr b.exr -o out.exr")
    expected = ngpt.reconstruct_with_error(stack, "wcv", halves=tuple(halves))
    assert np.allclose(ngpt.read("out.exr")["error"], expected.error, rtol=1e-5)


def test_it_says_how_far_the_truth_is(stack):
    """The error of a method that removes noise is never claimed too small on a flat image, where there is no bias."""
    result = ngpt.reconstruct_with_error(stack, "wcv")
    within = np.mean(np.abs(result.image - 1) <= result.error)
    assert 0.6 < within < 0.95 and np.mean(result.error) < 0.5 * np.mean(np.sqrt(stack["primal_var"]))
