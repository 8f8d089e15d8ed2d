"""ngpt.Denoiser, called as Mitsuba's are."""

import numpy as np
import pytest
from full_stack import full_layers, full_stack
from shots import frame_of, mse, view

import ngpt
from ngpt.errors import NgptError
from ngpt.stack import GradientStack


@pytest.fixture
def arrays():
    layers = full_layers(18, 26)
    layers["noisy"] = layers.pop("primal")
    # As a sensor of Mitsuba sees them: +x left, +z forward.
    layers["normals"] = layers.pop("normal") * np.array([-1, 1, -1], np.float32)
    return layers


@pytest.fixture
def bitmap(renderer, arrays):
    """What Mitsuba's films give: one image of many channels, named in the header of the file."""
    alpha = np.linspace(0, 1, 18 * 26, dtype=np.float32).reshape(18, 26, 1)
    pixels = np.concatenate([arrays["noisy"], alpha, arrays["albedo"], arrays["normals"]], axis=-1)
    names = [*"RGBA", *(f"albedo.{c}" for c in "RGB"), *(f"sh_normal.{c}" for c in "XYZ")]
    return renderer.Bitmap(np.float32(pixels), channel_names=names)


def test_the_same_as_denoise(arrays):
    result = ngpt.Denoiser((26, 18), albedo=True, normals=True)(**arrays)
    assert np.array_equal(result, ngpt.denoise(full_stack(18, 26)))


def test_a_noisy_image_alone(arrays):
    """The best that this machine can do with it; the identity only where it is asked for."""
    identity = ngpt.Denoiser((26, 18), method="primal")
    assert np.array_equal(identity(arrays["noisy"]), arrays["noisy"])
    denoised = ngpt.Denoiser((26, 18))(arrays["noisy"])
    assert denoised.shape == arrays["noisy"].shape and not np.array_equal(denoised, arrays["noisy"])


@pytest.mark.parametrize("size", [3, 4])
def test_normals_in_world_space(arrays, size):
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    world = arrays | {"normals": (arrays["normals"] @ matrix[:3, :3]).astype(np.float32)}
    turned = denoiser(**world, to_sensor=matrix[:size, :size])
    assert np.allclose(turned, denoiser(**arrays), rtol=1e-4)
    assert not np.allclose(denoiser(**world), turned, rtol=1e-3)


def test_code_written_for_mitsuba_runs(renderer, arrays):
    """By position, with the transform that its documentation shows, normals in world space, and empty tensors."""
    mi, stack = renderer, full_stack(18, 26)
    world = mi.ScalarTransform4f().look_at(origin=[3, 2, 5], target=[0, 1, 0], up=[0, 1, 0])
    in_world = (arrays["normals"] @ np.array(world.matrix)[:3, :3].T).astype(np.float32)
    noisy, albedo, normals = (mi.TensorXf(array) for array in (arrays["noisy"], arrays["albedo"], in_world))
    denoiser = ngpt.Denoiser([26, 18], True, True, False, False)
    expected = ngpt.denoise(stack["primal"], albedo=stack["albedo"], normal=stack["normal"])
    for to_sensor in (world.inverse(), mi.Transform4f(world).inverse()):
        result = denoiser(noisy, albedo, normals, to_sensor, mi.TensorXf(), mi.TensorXf())
        assert np.allclose(result.numpy(), expected, rtol=1e-3, atol=1e-5)


def test_bitmaps_of_many_channels(renderer, arrays, bitmap):
    mi = renderer
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    result = denoiser(bitmap, albedo_ch="albedo", normals_ch="sh_normal", to_sensor=mi.ScalarTransform4f())
    assert isinstance(result, mi.Bitmap) and result.pixel_format() == mi.Bitmap.PixelFormat.RGBA
    expected = denoiser(arrays["noisy"], arrays["albedo"], arrays["normals"])
    assert np.array_equal(np.array(result)[..., :3], expected)
    assert np.array_equal(np.array(result)[..., 3], np.array(bitmap)[..., 3])
    by_position = denoiser(bitmap, "albedo", "sh_normal", None, "", "", "<root>")
    assert np.array_equal(np.array(by_position), np.array(result))
    # Another layer as the image, and an array beside a bitmap.
    albedo = ngpt.Denoiser((26, 18), method="primal")(bitmap, noisy_ch="albedo")
    assert np.array_equal(np.array(albedo), arrays["albedo"])
    with pytest.raises(NgptError, match="the bitmap has no layer 'nn'; it has: <root>, albedo, sh_normal"):
        denoiser(bitmap, "albedo", "nn")


def test_normals_of_mitsuba_become_those_of_a_stack(renderer, monkeypatch):
    """The code of its documentation on a scene, and the normals that our own renderer gives for it."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene
    from ngpt.methods import METHODS, Method

    mi = renderer
    monkeypatch.setitem(METHODS, "normal", Method("", ("primal",), lambda data: data.features["normal"], {}))
    scene = load_scene("diffuse", (24, 16))
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normals:sh_normal", "image": {"type": "path"}})
    sensor = scene.sensors()[0]
    mi.render(scene, integrator=aov, spp=16)
    to_sensor = sensor.world_transform().inverse()
    denoiser = ngpt.Denoiser(sensor.film().crop_size(), albedo=True, normals=True, method="normal")
    seen = denoiser(sensor.film().bitmap(), albedo_ch="albedo", normals_ch="normals", to_sensor=to_sensor)
    error = np.abs(np.array(seen)[..., :3] - render_stack(scene, 16, 0, "gpt", unbiased=True)["normal"]).mean(
        axis=(0, 1)
    )
    assert (error < 0.05).all()


def test_alpha_is_denoised_where_that_is_asked_for(arrays, rng):
    coverage = np.float32(np.mgrid[0:18, 0:26][1] > 12)[..., None]
    alpha = np.float32(coverage + rng.normal(0, 0.1, coverage.shape))
    noisy = np.concatenate([arrays["noisy"], alpha], axis=-1)
    result = ngpt.Denoiser((26, 18), denoise_alpha=True)(noisy)
    assert np.array_equal(result[..., :3], ngpt.Denoiser((26, 18))(arrays["noisy"]))
    assert np.abs(result[..., 3:] - coverage).mean() < 0.7 * np.abs(alpha - coverage).mean()
    assert alpha.min() <= result[..., 3].min() and result[..., 3].max() <= alpha.max()


@pytest.fixture
def shot(rng):
    """Frames of a camera that goes to the right by a pixel a frame, and the truth."""
    views = [view(18, 26, offset=i) for i in range(4)]
    return [frame_of(image, features, rng, (1, 0)) for image, features in views], [image for image, _ in views]


def frames(stacks, denoiser, **more):
    """What a denoiser makes of frames; ``flow`` leads from the last frame to this one, ``motion`` back."""
    known = [(stack["primal"], stack["albedo"], stack["primal_var"], -stack["motion"]) for stack in stacks]
    return [denoiser(noisy, albedo, primal_var=var, flow=flow, **more) for noisy, albedo, var, flow in known]


def over_time(**options):
    return ngpt.Denoiser((26, 18), albedo=True, temporal=True, method="primal", **options)


def test_frames_are_blended_with_those_before(shot):
    stacks, truth = shot
    known = ("primal", "primal_var", "albedo", "motion")
    temporal, made = ngpt.Temporal(), frames(stacks, over_time())
    for stack, image in zip(stacks, made, strict=True):
        stack = GradientStack({name: stack[name] for name in known})
        assert np.array_equal(temporal.next(stack, stack["primal"]), image)
    assert np.array_equal(made[0], stacks[0]["primal"])
    assert mse(made[-1], truth[-1]) < 0.7 * mse(stacks[-1]["primal"], truth[-1])


def test_the_previous_frame_is_taken_as_it_was_given(shot):
    stacks, truth = shot
    noisy = stacks[1]["primal"]
    first, second = frames(stacks[:2], over_time())
    # As OptiX wants it: in a first frame the noisy image.
    denoiser = over_time()
    assert np.array_equal(frames(stacks[:1], denoiser, previous_denoised=stacks[0]["primal"])[0], first)
    assert np.allclose(frames(stacks[1:2], denoiser, previous_denoised=first)[0], second, atol=1e-5)
    denoiser = over_time()
    frames(stacks[:1], denoiser)
    assert np.array_equal(frames(stacks[1:2], denoiser, previous_denoised=noisy)[0], noisy)
    # Made elsewhere, by somebody who knew better
    knew = np.float32(truth[0])
    knew[3, 4] = np.nan
    for denoiser, told in ((over_time(), ()), (over_time(), stacks[:1])):
        frames(told, denoiser)
        (result,) = frames(stacks[1:2], denoiser, previous_denoised=knew)
        assert mse(result, truth[1]) < 0.95 * mse(second, truth[1])


def test_transforms_may_scale_and_not_flatten(arrays):
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    assert np.allclose(denoiser(**arrays, to_sensor=7 * np.eye(3)), denoiser(**arrays), rtol=1e-4)
    for flat in (np.diag([1, 1, 0]), np.full((3, 3), np.nan)):
        with pytest.raises(NgptError, match="to_sensor has determinant"):
            denoiser(**arrays, to_sensor=flat)
