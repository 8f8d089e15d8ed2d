"""Peers: they denoise what a path tracer gives, and say so when they cannot."""

from dataclasses import replace

import numpy as np
import pytest
from full_stack import full_stack
from textured_room import error, keeps_texture, textured_room

from ngpt.denoisers import clean, oidn
from ngpt.denoisers.nfor import nfor
from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.methods import METHODS, reconstruct
from ngpt.network import inputs
from ngpt.repair import repair
from ngpt.stack import GradientStack


@pytest.fixture
def room(rng):
    return textured_room(rng)


@pytest.mark.parametrize("name", ("nfor", "oidn"))
def test_noise_falls_and_texture_stays(room, name):
    if METHODS[name].missing():
        pytest.skip(METHODS[name].missing())
    keeps_texture(name, *room)


@pytest.mark.parametrize(
    "variance", [1e38, pytest.param(None, marks=pytest.mark.slow), pytest.param(np.inf, marks=pytest.mark.slow)]
)
def test_one_pixel_of_1e30_leaves_nfor_the_others(room, variance):
    stack, clean = room
    usual = reconstruct(stack, "nfor").image
    primal, variances = stack["primal"].copy(), stack["primal_var"].copy()
    primal[10, 9] = 1e30
    if variance is not None:
        variances[10, 9] = variance
    image = reconstruct(stack.replace(primal=primal, primal_var=variances), "nfor").image
    assert np.isfinite(image).all()
    far = np.ones(image.shape[:2], bool)
    far[:21, :20] = False  # its neighbourhood
    assert np.median(np.abs(image - usual)[far] / clean[far]) < 0.01


def test_nfor_fits_what_is_linear_in_the_features(rng):
    feature = rng.random((24, 20, 1)).astype(np.float32)
    clean = (2 + 3 * feature) * np.array([1.0, 0.5, 0.25])
    variance = np.full_like(clean, 0.25)
    image = clean + rng.normal(0, 0.5, clean.shape)
    assert np.abs(nfor(image, variance, [feature]) - clean).max() < 0.4  # noise reaches 1.5
    assert np.mean((nfor(image, variance, [feature]) - clean) ** 2) < 0.05 * 0.25


def test_nfor_keeps_what_is_free_of_noise(rng):
    image = rng.random((20, 22, 3)).astype(np.float32)
    result = nfor(image, np.zeros_like(image), [np.ones((20, 22, 1), np.float32)])
    assert np.abs(result - image).max() < 1e-4
    unknown = nfor(image, np.full_like(image, np.nan), [np.ones((20, 22, 1), np.float32)])
    assert np.isfinite(unknown).all()


def test_nfor_does_not_smear_a_spot_of_light_over_the_dark():
    """Seen on veach-mis: the reflection of a small lamp on a black plate, with a variance to match."""
    image, variance = np.zeros((2, 30, 30, 3), np.float32)
    image[15, 15:17], variance[15, 15:17] = 165, 88**2
    feature = np.linspace(0, 1, 900, dtype=np.float32).reshape(30, 30, 1)
    result = nfor(image, variance, [feature])
    result[15, 15:17] = 0
    assert np.abs(result).max() < 0.05


def test_oidn_is_given_what_is_best_for_it(room, monkeypatch):
    """A fake records the call: features in their ranges, prefiltered ones called clean."""
    calls = []
    monkeypatch.setattr(
        oidn, "filtered", lambda images, device="auto", **settings: calls.append(images | settings) or images["color"]
    )
    monkeypatch.setattr(oidn, "find_spec", lambda name: object())
    monkeypatch.setattr(oidn, "_prefiltered", lambda name, layer, quality: layer * 0.5)
    stack, _ = room
    stack = stack.replace(albedo=stack["albedo"] * 2)
    for auxiliary in oidn.AUXILIARY:
        reconstruct(stack, "oidn", auxiliary=auxiliary)
    prefiltered, clean, noisy, none = calls
    assert prefiltered["clean_aux"] and clean["clean_aux"] and not noisy["clean_aux"]
    assert prefiltered["albedo"].max() == 0.5 and noisy["albedo"].max() == 1.0
    assert "albedo" not in none and all(call["hdr"] for call in calls)


def test_an_absent_peer_says_what_to_install(room, monkeypatch):
    monkeypatch.setattr(oidn, "find_spec", lambda name: None)
    with pytest.raises(NgptError, match=r"method 'oidn'.*not installed: .*pip install mitsuba-oidn"):
        reconstruct(room[0], "oidn")


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
@pytest.mark.parametrize("noise", [None, 0.0, 0.99, 1.01, float("nan")])
@pytest.mark.parametrize("scale", [1000, pytest.param(1, marks=pytest.mark.slow)])
def test_a_combiner_is_given_oidns_images_by_clean_features(noise, scale):
    """Features are prefiltered unless their noise is known to be little beside the image's, whatever the exposure."""
    image = np.full((40, 50, 3), scale, np.float32)
    stack = full_stack(40, 50).replace(primal=image, direct=0 * image, primal_var=0.25 * image**2)
    if noise is not None:
        stack.attributes[FEATURE_NOISE] = noise * clean.CLEAN * 0.25 / (1 + clean.DARK)
    data = repair(stack)
    base = 0.9 * data.image
    features = data.features | ({} if noise in (0.0, 0.99) else oidn.prefiltered(data.features, "balanced"))
    images = inputs.denoised(inputs.Oidn(data), base, inputs.DENOISED)
    for name, image, quality in (("denoised", data.image, "high"), ("denoised_base", base, "fast")):
        expected = oidn.oidn(replace(data, image=image, features=features), "clean", quality)
        assert np.allclose(images[name], expected, rtol=1e-5, atol=1e-6)
    by_oidn = inputs.Oidn(data)
    assert inputs.denoised(by_oidn, base, ("primal",)) == {} == inputs.denoised(by_oidn, None, ("denoised_base",))


@pytest.mark.parametrize("layers", [(), ("albedo",), ("normal",), ("albedo", "normal")])
@pytest.mark.parametrize("auxiliary", oidn.AUXILIARY)
@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_oidn_takes_what_there_is(rng, layers, auxiliary):
    y, x = np.mgrid[0:30, 0:40]
    clean = (1 + 0.5 * np.cos((x + y) / 9))[..., None] * np.array([1.0, 0.9, 0.8])
    noisy = clean * (1 + 0.3 * rng.normal(size=clean.shape))
    flat = {"albedo": np.full_like(clean, 0.5), "normal": np.broadcast_to([0.0, 0, 1], clean.shape)}
    poor = GradientStack.from_arrays(primal=noisy, **{name: flat[name] for name in layers})
    image = reconstruct(poor, "oidn", auxiliary=auxiliary).image
    assert error(image, clean) < 0.2 * error(noisy, clean)
    # It knows no normals without albedo.
    if layers == ("normal",):
        bare = reconstruct(GradientStack.from_arrays(primal=noisy), "oidn", auxiliary=auxiliary).image
        assert np.array_equal(image, bare)
