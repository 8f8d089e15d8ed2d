"""GradientStack: what it accepts, what it refuses and how it says so."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.stack import GradientStack


def image(height=3, width=4, channels=3, dtype=np.float32):
    return np.arange(height * width * channels).reshape(height, width, channels).astype(dtype)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "g", ">f4", ">f8", "u1", "i2", "i4", "u8"])
def test_every_real_type_becomes_contiguous_float32(dtype):
    stack = GradientStack.from_arrays(primal=image(dtype=dtype))
    assert stack["primal"].dtype == np.float32 and stack["primal"].flags.c_contiguous
    assert np.array_equal(stack["primal"], image())


@pytest.mark.parametrize(
    "view",
    [
        lambda a: a[::-1],
        lambda a: a[:, ::-1],
        lambda a: a[1:, 2:],
        lambda a: a.transpose(1, 0, 2),
        lambda a: np.asfortranarray(a),
        lambda a: np.broadcast_to(a[:1], a.shape),
        lambda a: a[..., ::-1],
    ],
)
def test_every_memory_layout_becomes_contiguous(view):
    array = view(image(5, 6))
    stack = GradientStack.from_arrays(primal=array)
    assert stack["primal"].flags.c_contiguous and np.array_equal(stack["primal"], array)


def test_arrays_that_fit_are_neither_copied_nor_modified():
    dx = image()
    dx.flags.writeable = False
    stack = GradientStack.from_arrays(primal=image(), dx=dx)
    assert stack["dx"] is dx
    assert stack["dx"][0, -1, 0] != 0, "the unused column is left alone"


def test_one_channel_layers_may_be_flat():
    stack = GradientStack.from_arrays(primal=image(), depth=image()[..., 0], alpha=image(channels=1))
    assert stack["depth"].shape == stack["alpha"].shape == (3, 4, 1)


def test_non_finite_values_are_legal():
    primal = image()
    primal[0, 0] = np.nan, np.inf, -np.inf
    assert np.array_equal(GradientStack.from_arrays(primal=primal.astype("f8"))["primal"], primal, equal_nan=True)


def test_sizes_names_and_membership():
    stack = GradientStack.from_arrays(dy=image(), primal=image(), attributes={"ngpt:spp": 4})
    assert (stack.height, stack.width) == (3, 4)
    assert stack.names == ("primal", "dy")
    assert "dy" in stack and "dx" not in stack
    assert stack.attributes == {"ngpt:spp": 4} and stack.source is None


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        ({}, "needs at least one layer"),
        ({"primal": image(), "gx": image()}, "no layer is called 'gx'; the layers are primal, direct, caustic, dx"),
        ({"primal": image().astype(complex)}, "layer 'primal' is of type complex128; convert it to float32"),
        ({"primal": image() > 1}, "layer 'primal' is of type bool"),
        ({"primal": image().astype(object)}, "layer 'primal' is of type object"),
        ({"primal": image().astype(str)}, "layer 'primal' is of type <U"),
        ({"primal": image(channels=4)}, "layer 'primal' has shape (3, 4, 4); it must be (height, width, 3)"),
        ({"primal": image(channels=1)}, "layer 'primal' has shape (3, 4, 1)"),
        ({"primal": image()[..., 0]}, "layer 'primal' has shape (3, 4)"),
        ({"primal": image(), "depth": image()}, "layer 'depth' has shape (3, 4, 3); it must be (height, width, 1)"),
        ({"primal": image()[None]}, "layer 'primal' has shape (1, 3, 4, 3)"),
        ({"primal": image(0, 4)}, "layer 'primal' is 4x0; it has no pixels"),
        ({"primal": image(3, 0)}, "layer 'primal' is 0x3; it has no pixels"),
        ({"primal": 1.0}, "layer 'primal' has shape ()"),
    ],
)
def test_arrays_that_are_no_layers(layers, expected):
    with pytest.raises(NgptError) as caught:
        GradientStack.from_arrays(path="a.exr", **layers)
    assert str(caught.value).startswith("a.exr: ") and expected in str(caught.value)


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        (
            "dx",
            (360, 639),
            "a.exr: layer 'dx' is 639x360 but 'primal' is 640x360; "
            "gradients are stored at image size with an unused last column: pad it with zeros",
        ),
        (
            "dy",
            (359, 640),
            "a.exr: layer 'dy' is 640x359 but 'primal' is 640x360; "
            "gradients are stored at image size with an unused last row: pad it with zeros",
        ),
        ("dx", (359, 640), "a.exr: layer 'dx' is 640x359 but 'primal' is 640x360; all layers of a stack"),
        ("albedo", (180, 320), "a.exr: layer 'albedo' is 320x180 but 'primal' is 640x360; all layers of a stack"),
    ],
)
def test_layers_of_different_size(name, shape, expected):
    layers = {name: np.zeros((*shape, 3), np.float32), "primal": np.zeros((360, 640, 3), np.float32)}
    with pytest.raises(NgptError) as caught:
        GradientStack.from_arrays(path="a.exr", **layers)
    assert str(caught.value).startswith(expected)


def test_finite_numbers_beyond_float32_are_refused_and_counted():
    primal = image(dtype="f8")
    primal[0, 0] = 1e39, -2e300, np.inf
    with pytest.raises(NgptError, match=r"layer 'primal' has 2 values that float32 cannot hold \(up to 2e\+300"):
        GradientStack.from_arrays(primal=primal)
    primal[0, 0] = 3.4e38, -1e12, np.inf
    assert GradientStack.from_arrays(primal=primal)["primal"][0, 0, 1] == np.float32(-1e12)


def test_missing_layers_are_named_with_the_remedy():
    stack = GradientStack.from_arrays(primal=image(), albedo=image(), path="a.exr")
    with pytest.raises(NgptError) as caught:
        stack["dx"]
    assert str(caught.value) == (
        "a.exr: no layer 'dx'; the stack holds primal, albedo; "
        "if the file has it under another name, pass --layer dx=NAME"
    )
    with pytest.raises(NgptError) as caught:
        stack.require("primal", "dx", "dy", why="method 'l1'")
    assert "a.exr: method 'l1' needs layers 'dx' and 'dy'; the stack holds primal, albedo" in str(caught.value)
    assert "--layer dx=NAME --layer dy=NAME" in str(caught.value) and "sampler" not in str(caught.value)
    stack.attributes["ngpt:sampler"] = "primal"
    with pytest.raises(NgptError, match="`ngpt render --sampler gpt`"):
        stack.require("dx", "dy", why="method 'l1'")
    with pytest.raises(NgptError, match="no layer is called 'gradient'"):
        stack["gradient"]
    stack.require("primal", "albedo")


def test_replace_makes_a_new_stack():
    stack = GradientStack.from_arrays(primal=image(), dx=image(), attributes={"a": 1}, path="a.exr")
    other = stack.replace(dx=image()[::-1], dy=image())
    other.attributes["a"] = 2
    assert np.array_equal(other["dx"], image()[::-1]) and "dy" in other
    assert np.array_equal(stack["dx"], image()) and "dy" not in stack and stack.attributes == {"a": 1}
    assert other["primal"] is stack["primal"] and other.path == "a.exr"
    with pytest.raises(NgptError, match="layer 'dx' is 2x2"):
        stack.replace(dx=image(2, 2))
