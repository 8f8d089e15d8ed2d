"""Where alpha is 0 and no light is, a result has none; light at alpha 0 and the light of hair stay."""

import numpy as np
import pytest
from full_stack import full_stack
from scipy.ndimage import uniform_filter

import ngpt
from ngpt.api.lightgroups import denoised
from ngpt.api.uncertainty import reconstruct_with_error
from ngpt.coverage import empty_pixels, kept_within
from ngpt.methods import METHODS
from ngpt.stack import GradientStack

SIZE = 40
USABLE = [name for name, method in METHODS.items() if not method.missing()]
Y, X = np.mgrid[:SIZE, :SIZE]
SHAPES = {"disc": (X - 20) ** 2 + (Y - 20) ** 2 < 120, "wires": X % 16 == 3, "fence": (X % 8 < 2) | (Y % 8 < 1)}
EMPTY = ~SHAPES["disc"]


def film(shape="disc"):
    """A shape on a transparent film, with all layers."""
    cover = SHAPES[shape][..., None].astype(np.float32)
    stack = full_stack(SIZE, SIZE)
    layers = {name: stack[name] * cover for name in stack.names if name not in ("dx", "dy", "dx_var", "dy_var")}
    return stack.replace(**layers, alpha=cover)


@pytest.mark.parametrize("name", USABLE)
def test_no_method_puts_light_where_nothing_is(name):
    image = ngpt.denoise(film(), name)
    assert not image[EMPTY].any() and image[~EMPTY].any()


@pytest.mark.parametrize("shape", ["disc", "fence", pytest.param("wires", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [name for name in ("oidn", "nfor") if name in USABLE])
def test_what_is_there_gets_no_worse(rng, name, shape):
    """Nor does light come from nowhere."""
    cover, empty = SHAPES[shape][..., None], ~SHAPES[shape]
    albedo = cover * np.array([0.8, 0.3, 0.1])
    clean = albedo * (1 + 0.5 * np.sin(X / 9))[..., None]
    noisy = clean * rng.gamma(2, 0.5, (SIZE, SIZE, 1))
    stack = GradientStack.from_arrays(primal=noisy, albedo=albedo, normal=cover * np.array([0, 0, 1.0]))
    free, image = ngpt.denoise(stack, name), ngpt.denoise(stack.replace(alpha=cover * 1.0), name)
    assert np.array_equal(empty_pixels(stack.replace(alpha=cover * 1.0)), empty)
    assert free[empty].any() and not image[empty].any()
    error = [np.square(each - clean)[~empty].mean() for each in (free, image)]
    assert error[1] <= 1.01 * error[0] and image.sum() <= 1.0001 * free.sum()


def test_every_way_in_knows_alpha(tmp_path):
    stack = film()
    rgba = np.concatenate([stack["primal"], stack["alpha"]], axis=-1)
    beside = {"albedo": stack["albedo"], "normals": stack["normal"], "flow": np.zeros((SIZE, SIZE, 2), np.float32)}
    denoiser = ngpt.Denoiser((SIZE, SIZE), albedo=True, normals=True, temporal=True)
    first, second = (denoiser(frame, **beside)[..., :3] for frame in (np.roll(rgba, 9, axis=1), rgba))
    assert not first[np.roll(EMPTY, 9, axis=1)].any()
    whole = ngpt.denoise(stack)
    groups = denoised(stack, {"key": 0.7 * stack["primal"], "fill": 0.3 * stack["primal"]}, whole)
    assert np.allclose(sum(groups.values()), whole, rtol=1e-4, atol=1e-5)
    results = [second, ngpt.denoise(rgba, albedo=stack["albedo"])[..., :3], reconstruct_with_error(stack, "auto").image]
    results.append(ngpt.denoise(ngpt.read(ngpt.write(tmp_path / "s.exr", stack))))
    for image in (*results, *groups.values()):
        assert not image[EMPTY].any() and image[~EMPTY].any()


def test_light_at_alpha_zero_stays_with_the_darkness_among_it():
    fire = np.zeros((SIZE, SIZE), bool)
    fire[1:5, 1:9] = True
    primal = film()["primal"].copy()
    primal[fire] = 0.5
    primal[3, 4] = 0  # by chance
    burning = film().replace(primal=primal)
    empty = empty_pixels(burning)
    assert not empty[:5, :9].any() and empty[:, 30].sum() > 20 and empty[10, 2]
    image = ngpt.denoise(burning, "l1")
    assert image[fire].all() and not image[empty].any()


@pytest.mark.parametrize("alpha", [0.0, np.nan, -0.5])
def test_an_alpha_that_covers_nothing_says_nothing(alpha):
    """As of files that hold zeros for want of any: dark pixels are noise there."""
    primal = full_stack(12, 14)["primal"].copy()
    primal[::2, ::2] = 0
    bare = GradientStack.from_arrays(primal=primal)
    stack = bare.replace(alpha=np.full((12, 14), alpha))
    assert not empty_pixels(stack).any()
    assert np.array_equal(ngpt.denoise(stack, "nfor"), ngpt.denoise(bare, "nfor"))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e12])
def test_hair_keeps_its_light(rng, scale):
    """Four samples of a tenth of cover: most pixels are empty by chance, and a method that evens them out is right."""
    hits = rng.binomial(4, 0.1, (SIZE, SIZE)) / 4
    noisy = (scale * hits[..., None] * [0.8, 0.3, 0.1]).astype(np.float32)
    even = np.broadcast_to(noisy.mean(axis=(0, 1)), noisy.shape).astype(np.float32)
    image = kept_within(even, GradientStack.from_arrays(primal=noisy, alpha=hits))
    assert not image[hits == 0].any() and (image >= 0).all()
    # Where it was dropped instead, two thirds of it were gone.
    assert even[hits > 0].sum() < 0.4 * even.sum() and 0.85 * even.sum() < image.sum() < 1.0001 * even.sum()
    ratio = image[..., 0][hits > 0] / hits[hits > 0]
    assert uniform_filter(ratio, 5).std() < 0.5 * ratio.mean()
