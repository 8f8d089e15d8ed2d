"""gpt where numbers are extreme: roughness, brightness, scale, place, size of the film, and odd cameras."""

from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from data_gen_scenes import moved, polished
from unbiased import load

from data_gen.render import render_stack


def render(scene, size=(24, 24), spp=32):
    return render_stack(load(mi, scene, size), spp, sampler="gpt", unbiased=True)


def check_sane(stack, most=1.5):
    """Nothing discarded, nothing brighter than the lamp allows, black borders."""
    assert stack.attributes["ngpt:discarded"] == 0
    assert stack["primal"].max() <= most and np.abs(stack["dx"]).max() <= 2 * most
    assert not stack["dx"][:, -1].any() and not stack["dy"][-1].any()


def seen_by(origin, target, **parts):
    scene = polished(0.2)
    look = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
    scene["sensor"] |= {"to_world": look}
    scene["ball"] |= parts
    return scene


# At 100 km float32 places vertices in steps of 8 mm: the image is wrong, but finite and dark.
EXTREMES = {
    **{f"roughness {alpha}": partial(polished, alpha) for alpha in (0.0, 1e-3, 1.0, 1e-4, 0.04, 0.06)},
    "too far away": lambda: moved(1, 1e5),
    "grazing": lambda: seen_by([0, 1e-3, 2.5], [0, 0, 0]),
    "at the edge": lambda: seen_by([0, 0.5, 2.9], [0, 0.5, 0]),
    "inside the ball": lambda: seen_by([0.4, 0.5, 0], [0.4, 0, 1]),
}
MORE = ("roughness 0.0001", "roughness 0.04", "roughness 0.06")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in MORE else ()) for n in EXTREMES])
def test_images_are_sane(renderer, name):
    check_sane(render(EXTREMES[name](), spp=64))


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_brightness(renderer, scale):
    dark = polished(0.2)
    dark["lamp"]["emitter"]["radiance"]["value"] = [scale] * 3
    one, scaled = (render(scene, (16, 16), 16) for scene in (polished(0.2), dark))
    assert scaled.attributes["ngpt:discarded"] == 0
    for name in ("primal", "dx", "dy"):
        assert np.allclose(scaled[name] / scale, one[name], rtol=1e-3, atol=1e-5), name


@pytest.mark.parametrize(("size", "spp"), [((1, 1), 1), ((3, 2), 5), ((2, 1), 1)])
def test_tiny_images(renderer, size, spp):
    stack = render("glossy", size, spp)
    assert stack["dx"].shape == (size[1], size[0], 3) and stack.attributes["ngpt:discarded"] == 0
    assert not stack["dx"][:, -1].any() and not stack["dy"][-1].any()


def test_inside_glass(renderer):
    scene = seen_by([0.4, 0.5, 0], [0.4, 0.3, 1], bsdf={"type": "dielectric"})
    stack = render(scene, spp=512)
    # Radiance is higher by the square of the index of refraction where the lamp is seen through the surface.
    check_sane(stack, most=1.505**2 * 1.5)
    theirs = np.array(mi.render(load(mi, scene, (24, 24)), spp=2048))
    assert stack["primal"].mean() == pytest.approx(theirs.mean(), rel=0.1)


def test_samples_that_are_not_finite_are_dropped_and_counted(renderer):
    """A lamp that shines with inf: its samples have no weight in any layer, and every one is counted."""
    endless = {"type": "area", "radiance": {"type": "uniform", "value": float("inf")}}
    spot = {"type": "sphere", "center": [-0.8, 1.0, 0], "radius": 0.05, "emitter": endless}
    stack = render(polished(0.2) | {"spot": spot}, spp=64)
    assert stack.attributes["ngpt:discarded"] > 0
    for name in ("primal", "dx", "dy"):
        # A pixel that lost all its samples is NaN, unknown, and no other is touched.
        assert not np.isinf(stack[name]).any() and np.isfinite(stack[name]).mean() > 0.5
