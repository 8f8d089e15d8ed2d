"""gpt where numbers are extreme: roughness, brightness, scale, place, size of the film, and odd cameras."""

import numpy as np
import pytest
from data_gen_scenes import moved, polished
from unbiased import load


def render(renderer, scene, size=(24, 24), spp=32):
    from data_gen.render import render_stack

    return render_stack(load(renderer, scene, size), spp, sampler="gpt")


def check_sane(stack, most=1.5):
    """Nothing discarded, nothing brighter than the lamp allows, black borders."""
    assert stack.attributes["ngpt:discarded"] == 0
    assert stack["primal"].max() <= most and np.abs(stack["dx"]).max() <= 2 * most
    assert not stack["dx"][:, -1].any() and not stack["dy"][-1].any()


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 1e-3, 0.04, 0.06, 1.0])
def test_any_roughness(renderer, alpha):
    check_sane(render(renderer, lambda: polished(alpha), spp=64))


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_brightness(renderer, scale):
    def scene(radiance):
        description = polished(0.2)
        description["lamp"]["emitter"]["radiance"]["value"] = [radiance] * 3
        return description

    one, scaled = (render(renderer, lambda radiance=radiance: scene(radiance), (16, 16), 16) for radiance in (1, scale))
    assert scaled.attributes["ngpt:discarded"] == 0
    for name in ("primal", "dx", "dy"):
        assert np.allclose(scaled[name] / scale, one[name], rtol=1e-3, atol=1e-5), name


def test_too_far_away(renderer):
    """Where float32 breaks: at 100 km it places vertices in steps of 8 mm. The image is wrong, but finite and dark."""
    check_sane(render(renderer, lambda: moved(1, 1e5)))


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (2, 1)])
@pytest.mark.parametrize("spp", [1, 5])
def test_tiny_images(renderer, size, spp):
    stack = render(renderer, "glossy", size, spp)
    assert stack["dx"].shape == (size[1], size[0], 3) and stack.attributes["ngpt:discarded"] == 0
    assert not stack["dx"][:, -1].any() and not stack["dy"][-1].any()


def seen_by(origin, target):
    def scene():
        import mitsuba as mi

        description = polished(0.2)
        to_world = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
        description["sensor"] |= {"to_world": to_world}
        return description

    return scene


@pytest.mark.parametrize(
    ("origin", "target"),
    [([0, 1e-3, 2.5], [0, 0, 0]), ([0, 0.5, 2.9], [0, 0.5, 0]), ([0.4, 0.5, 0], [0.4, 0, 1])],
    ids=["grazing", "at the edge", "inside the ball"],
)
def test_odd_cameras(renderer, origin, target):
    check_sane(render(renderer, seen_by(origin, target)))


def test_inside_glass(renderer):
    def scene():
        description = seen_by([0.4, 0.5, 0], [0.4, 0.3, 1])()
        description["ball"]["bsdf"] = {"type": "dielectric"}
        return description

    stack = render(renderer, scene, spp=1024)
    # Radiance is higher by the square of the index of refraction where the lamp is seen through the surface.
    check_sane(stack, most=1.505**2 * 1.5)
    assert stack["primal"].mean() == pytest.approx(
        np.array(renderer.render(load(renderer, scene, (24, 24)), spp=4096)).mean(), rel=0.1
    )


def test_samples_that_are_not_finite_are_dropped_and_counted(renderer):
    """A lamp that shines with inf: its samples have no weight in any layer, and every one is counted."""

    def scene():
        description = polished(0.2)
        endless = {"type": "area", "radiance": {"type": "uniform", "value": float("inf")}}
        description["spot"] = {"type": "sphere", "center": [-0.8, 1.0, 0], "radius": 0.05, "emitter": endless}
        return description

    stack = render(renderer, scene, spp=64)
    assert stack.attributes["ngpt:discarded"] > 0
    for name in ("primal", "dx", "dy"):
        # A pixel that lost all its samples is NaN, unknown, and no other is touched.
        assert not np.isinf(stack[name]).any() and np.isfinite(stack[name]).mean() > 0.5
