"""ngpt.Denoiser, called as Mitsuba's are."""

import numpy as np
import pytest
from full_stack import full_layers, full_stack

import ngpt
from ngpt.errors import NgptError


@pytest.fixture
def arrays():
    layers = full_layers(18, 26)
    layers["noisy"], layers["normals"] = layers.pop("primal"), layers.pop("normal")
    return layers


def call(denoiser, arrays):
    arrays = dict(arrays)
    return denoiser(arrays.pop("noisy"), **arrays)


def test_the_same_as_denoise(arrays):
    result = call(ngpt.Denoiser((26, 18), albedo=True, normals=True), arrays)
    assert np.array_equal(result, ngpt.denoise(full_stack(18, 26)))


def test_a_noisy_image_alone(arrays):
    """The best that this machine can do with it; the identity only where it is asked for."""
    identity = ngpt.Denoiser((26, 18), method="primal")
    assert np.array_equal(identity(arrays["noisy"]), arrays["noisy"])
    denoised = ngpt.Denoiser((26, 18))(arrays["noisy"])
    assert denoised.shape == arrays["noisy"].shape and not np.array_equal(denoised, arrays["noisy"])


def test_methods_and_their_options(arrays):
    gradients = {name: arrays[name] for name in ("noisy", "dx", "dy")}
    denoised = call(ngpt.Denoiser((26, 18), method="l2", alpha=0.1), gradients)
    assert np.array_equal(denoised, ngpt.denoise(full_stack(18, 26), "l2", alpha=0.1))
    with pytest.raises(NgptError, match="unknown method 'l3'"):
        ngpt.Denoiser((26, 18), method="l3")


def test_torch_tensors(arrays):
    torch = pytest.importorskip("torch")
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    tensors = {name: torch.tensor(array, requires_grad=name == "noisy") for name, array in arrays.items()}
    result = call(denoiser, tensors)
    assert isinstance(result, torch.Tensor) and result.dtype == torch.float32
    assert np.array_equal(result.numpy(), call(denoiser, arrays))
    half = call(denoiser, {name: tensor.detach().bfloat16() for name, tensor in tensors.items()})
    assert half.dtype == torch.bfloat16 and np.allclose(half.float(), result, rtol=0.1, atol=0.1)


def test_dr_jit_tensors(renderer, arrays):
    mi = renderer
    denoiser = ngpt.Denoiser(mi.ScalarVector2u(26, 18), albedo=True, normals=True)
    result = call(denoiser, {name: mi.TensorXf(array) for name, array in arrays.items()})
    assert isinstance(result, mi.TensorXf)
    assert np.array_equal(np.array(result), call(denoiser, arrays))


def test_alpha_is_left_alone(arrays):
    alpha = np.linspace(0, 1, 18 * 26, dtype=np.float32).reshape(18, 26, 1)
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    result = call(denoiser, arrays | {"noisy": np.concatenate([arrays["noisy"], alpha], axis=-1)})
    assert np.array_equal(result[..., 3:], alpha) and np.array_equal(result[..., :3], call(denoiser, arrays))


@pytest.mark.parametrize("size", [3, 4])
def test_normals_in_world_space(arrays, size):
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    denoiser = ngpt.Denoiser((26, 18), albedo=True, normals=True)
    world = arrays | {"normals": (arrays["normals"] @ matrix[:3, :3]).astype(np.float32)}
    turned = call(denoiser, world | {"to_sensor": matrix[:size, :size]})
    assert np.allclose(turned, call(denoiser, arrays), rtol=1e-4)
    assert not np.allclose(call(denoiser, world), turned, rtol=1e-3)


def test_bad_calls(arrays):
    with pytest.raises(NgptError, match=r"albedo is given, but was not announced: Denoiser\(size, albedo=True\)"):
        call(ngpt.Denoiser((26, 18), normals=True), arrays)
    with pytest.raises(NgptError, match="normals was announced, but is not given"):
        ngpt.Denoiser((26, 18), normals=True)(arrays["noisy"])
    with pytest.raises(NgptError, match=r"noisy has shape \(18, 26, 3\); it must be \(26, 18, 3\) or \(26, 18, 4\)"):
        ngpt.Denoiser((18, 26))(arrays["noisy"])
    with pytest.raises(NgptError, match=r"dx has shape \(17, 26, 3\)"):
        ngpt.Denoiser((26, 18))(arrays["noisy"], dx=arrays["dx"][1:], dy=arrays["dy"])
