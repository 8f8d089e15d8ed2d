"""ngpt.denoise on arrays of any library: the same kind comes back; what does not fit is said with its remedy."""

from types import SimpleNamespace

import numpy as np
import pytest
from full_stack import full_layers, full_stack

import ngpt
from ngpt.errors import NgptError
from ngpt.methods import by_standing


@pytest.fixture
def layers():
    return full_layers(18, 26)


@pytest.fixture
def features(layers):
    return {name: layers[name] for name in ("albedo", "normal")}


def with_alpha(image):
    alpha = np.linspace(0, 1, image.shape[0] * image.shape[1], dtype=image.dtype)
    return np.concatenate([image, alpha.reshape(*image.shape[:2], 1)], axis=-1)


def test_a_stack_is_what_it_was(layers):
    stack = full_stack(18, 26)
    expected = ngpt.reconstruct(stack).image
    assert np.array_equal(ngpt.denoise(stack), expected)
    # The same layers as arrays; and those beside a stack that holds the others.
    assert np.array_equal(ngpt.denoise(layers.pop("primal"), **layers), expected)
    part = ngpt.GradientStack({"primal": stack["primal"]})
    assert np.array_equal(ngpt.denoise(part, **layers), expected)


@pytest.mark.parametrize(("dtype", "channels"), [("float16", 3), ("float32", 4), ("float64", 4), (">f4", 3)])
def test_numpy(layers, features, dtype, channels):
    image = with_alpha(layers["primal"]).astype(dtype)[..., :channels]
    before = image.copy()
    result = ngpt.denoise(image, **features)
    assert isinstance(result, np.ndarray) and result.dtype == image.dtype and result.shape == image.shape
    assert np.array_equal(result[..., 3:], image[..., 3:]) and np.array_equal(image, before)
    expected = ngpt.denoise(ngpt.GradientStack({"primal": image[..., :3], **features}))
    assert np.array_equal(result[..., :3], expected.astype(dtype))
    assert not np.array_equal(result, image)


@pytest.mark.parametrize("dtype", ["bfloat16", "float64"])
def test_torch(layers, features, dtype):
    torch = pytest.importorskip("torch")
    image = torch.tensor(with_alpha(layers["primal"])).to(getattr(torch, dtype))
    result = ngpt.denoise(image, **{name: torch.tensor(feature) for name, feature in features.items()})
    assert isinstance(result, torch.Tensor) and result.dtype == image.dtype and result.shape == image.shape
    assert result.device == image.device and torch.equal(result[..., 3], image[..., 3])
    expected = ngpt.denoise(image.detach().float().numpy(), **features)
    assert torch.equal(result, torch.tensor(expected).to(image.dtype))


def test_gradients_of_torch_do_not_end_in_silence(layers):
    torch = pytest.importorskip("torch")
    image = torch.tensor(layers["primal"], requires_grad=True)
    with pytest.raises(NgptError, match=r"denoise: image carries gradients.*; pass image\.detach\(\)"):
        ngpt.denoise(image, "primal")
    with pytest.raises(NgptError, match=r"pass albedo\.detach\(\)"):
        ngpt.Denoiser((26, 18), albedo=True, method="primal")(image.detach(), image)
    with torch.no_grad():
        assert torch.equal(ngpt.denoise(image, "primal"), image)
    # As docs/use/python.md has it.
    clean = image + (ngpt.denoise(image.detach(), "oidn") - image).detach()
    assert torch.allclose(clean, ngpt.denoise(image.detach(), "oidn"), atol=1e-5)
    clean.sum().backward()
    assert torch.equal(image.grad, torch.ones_like(image))


def test_torch_on_a_graphics_card(layers, features):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no GPU for PyTorch")
    result = ngpt.denoise(torch.tensor(layers["primal"], device="cuda"), **features)
    assert result.is_cuda and np.array_equal(result.cpu().numpy(), ngpt.denoise(layers["primal"], **features))


def test_dr_jit(renderer, layers, features):
    import drjit as dr

    mi = renderer
    image = with_alpha(layers["primal"])
    expected = ngpt.denoise(image, **features)
    for tensor in (mi.TensorXf, dr.llvm.TensorXf, dr.llvm.ad.TensorXf16, dr.llvm.TensorXf64):
        result = ngpt.denoise(tensor(image), **{name: mi.TensorXf(feature) for name, feature in features.items()})
        assert type(result) is tensor and result.shape == image.shape
        assert np.allclose(result.numpy(), expected, rtol=0.02, atol=0.01)
    tracked = mi.TensorXf(image)
    dr.enable_grad(tracked)
    with pytest.raises(NgptError, match=r"pass drjit\.detach\(image\)"):
        ngpt.denoise(tracked)
    further = {name: layers[name] for name in ("dx", "dy")}
    made = ngpt.denoise(mi.TensorXf(layers["primal"]), "l2", **further, alpha=0.1).numpy()
    assert np.array_equal(made, ngpt.denoise(layers["primal"], "l2", **further, alpha=0.1))


@pytest.mark.parametrize(("dtype", "channels"), [("float16", 4), ("float32", 3)])
def test_bitmaps(renderer, layers, features, dtype, channels):
    mi = renderer
    pixels = with_alpha(layers["primal"]).astype(dtype)[..., :channels]
    image = mi.Bitmap(np.ascontiguousarray(pixels))
    result = ngpt.denoise(image, **{name: mi.Bitmap(feature) for name, feature in features.items()})
    assert isinstance(result, mi.Bitmap)
    assert result.pixel_format() == image.pixel_format() and result.component_format() == image.component_format()
    assert np.array_equal(np.array(result), ngpt.denoise(pixels, **features))
    shown = image.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    with pytest.raises(NgptError, match=r"denoise: image is a bitmap with the curve of displays; .*srgb_gamma=False"):
        ngpt.denoise(shown)


def test_bitmaps_of_many_channels_are_read_by_their_names(renderer, layers, features):
    mi = renderer
    pixels = np.concatenate([with_alpha(layers["primal"]), layers["albedo"], layers["normal"]], axis=-1)
    names = [*"RGBA", *(f"albedo.{c}" for c in "RGB"), *(f"sh_normal.{c}" for c in "XYZ")]
    bitmap = mi.Bitmap(np.float32(pixels), channel_names=names)
    result = ngpt.denoise(bitmap)
    assert result.pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert np.array_equal(np.array(result), ngpt.denoise(with_alpha(layers["primal"]), **features))
    # What is passed beside it counts.
    other = ngpt.denoise(bitmap, albedo=np.ones_like(layers["albedo"]))
    assert not np.array_equal(np.array(other), np.array(result))


class OfALibrary:
    """An array as JAX's are: read through DLPack or ``__array__``, and made by the functions of its namespace."""

    def __init__(self, array):
        self.array = np.array(array)
        self.shape, self.dtype = self.array.shape, self.array.dtype

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.array, dtype)

    def __array_namespace__(self):
        return SimpleNamespace(asarray=lambda array, dtype: OfALibrary(array.astype(dtype)))


def test_arrays_of_other_libraries(layers, features):
    expected = ngpt.denoise(layers["primal"], **features)
    result = ngpt.denoise(OfALibrary(layers["primal"]), **{name: OfALibrary(a) for name, a in features.items()})
    assert isinstance(result, OfALibrary) and np.array_equal(result.array, expected)
    # Of no library that can make arrays: NumPy's come back.
    assert np.allclose(ngpt.denoise(layers["primal"].tolist(), **features), expected, rtol=1e-5)


def test_help_names_methods_and_options():
    """Names come from the registry, so that nothing has to be kept in step."""
    import pydoc

    for thing in (ngpt, ngpt.denoise, ngpt.Denoiser):
        text = pydoc.plain(pydoc.render_doc(thing))
        for name, method in by_standing("use", "niche").items():
            assert f"{name} " in text and method.summary in text
            assert all(f"{name}={option.default!r}" in text for name, option in method.options.items())
    assert set(ngpt.__all__) <= set(dir(ngpt))


def test_what_the_package_brings_in_at_once_is_next_to_nothing():
    """The rest comes with the first name that is asked for."""
    import subprocess
    import sys

    code = "import sys; import ngpt; print(*sorted(m for m in sys.modules if m.startswith(('ngpt', 'numpy'))))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["ngpt", "ngpt.version"]
    code = "import sys, ngpt; help(ngpt); print(*{'torch', 'mitsuba', 'drjit', 'onnx', 'skimage'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "ngpt-fast" in out and out.splitlines()[-1] == ""
