"""GradientStack: what it accepts, what it refuses and how it says so."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.stack import GradientStack


def image(height=3, width=4, channels=3, dtype=np.float32):
    return np.arange(height * width * channels).reshape(height, width, channels).astype(dtype)


@pytest.mark.parametrize("dtype", ["f2", "g", ">f4", ">f8", "u1", "i4", "u8"])
def test_every_real_type_becomes_contiguous_float32(dtype):
    stack = GradientStack.from_arrays(primal=image(dtype=dtype))
    assert stack["primal"].dtype == np.float32 and stack["primal"].flags.c_contiguous
    assert np.array_equal(stack["primal"], image())


def test_a_stack_is_a_mapping_of_its_layers():
    stack = GradientStack.from_arrays(dx=image(), primal=image(), path="a.exr")
    assert list(stack) == list(stack.keys()) == ["primal", "dx"] and len(stack) == 2
    assert dict(stack).keys() == stack.layers.keys() and {**stack}["dx"] is stack["dx"]
    assert [name for name, layer in stack.items() if layer is stack[name]] == ["primal", "dx"]
    assert stack.get("dx") is stack["dx"] and stack.get("dy") is None and stack.get("dy", 3) == 3
    assert stack == stack and stack != GradientStack(dict(stack)) and len({stack}) == 1
    for name in (0, None, ("primal", "dx")):
        with pytest.raises(NgptError, match="no layer is called"):
            stack[name]


def test_numbers_are_numbers():
    stack = GradientStack.from_arrays(primal=image(), attributes={"a": 3, "b": 0.5, "c": np.float32(2)})
    assert [stack.number(name) for name in "abc"] == [3, 0.5, 2] and stack.number("d") is None
    for value in ("3", True, np.nan, -np.inf, np.ones(2), None, [1.0]):
        stack.attributes["a"] = value
        assert stack.number("a") is None


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
        ({"primal": image()[..., 0]}, "layer 'primal' has shape (3, 4)"),
        ({"primal": image(), "depth": image()}, "layer 'depth' has shape (3, 4, 3); it must be (height, width, 1)"),
        ({"primal": image()[None]}, "layer 'primal' has shape (1, 3, 4, 3)"),
        ({"primal": image(0, 4)}, "layer 'primal' is 4x0; it has no pixels"),
        ({"primal": 1.0}, "layer 'primal' has shape ()"),
        ({"dx": image(3, 3), "primal": image()}, "stored at image size with an unused last column: pad it with zeros"),
        ({"dy": image(2, 4), "primal": image()}, "stored at image size with an unused last row: pad it with zeros"),
        ({"dx": image(2, 4), "primal": image()}, "layer 'dx' is 4x2 but 'primal' is 4x3; render or crop all"),
        ({"albedo": image(1, 2), "primal": image()}, "layer 'albedo' is 2x1 but 'primal' is 4x3; render or crop all"),
    ],
)
def test_arrays_that_are_no_layers(layers, expected):
    with pytest.raises(NgptError) as caught:
        GradientStack.from_arrays(path="a.exr", **layers)
    assert str(caught.value).startswith("a.exr: ") and expected in str(caught.value)


def test_finite_numbers_beyond_float32_are_refused_and_counted():
    primal = image(dtype="f8")
    primal[0, 0] = 1e39, -2e300, np.inf
    with pytest.raises(NgptError, match=r"layer 'primal' has 2 values that float32 cannot hold \(up to 2e\+300"):
        GradientStack.from_arrays(primal=primal)
    primal[0, 0], primal[0, 1] = (3.4e38, -1e12, np.inf), (np.nan, -np.inf, 0)
    assert np.array_equal(GradientStack.from_arrays(primal=primal)["primal"], np.float32(primal), equal_nan=True)


def test_missing_layers_are_named_with_the_remedy():
    stack = GradientStack.from_arrays(primal=image(), albedo=image(), path="a.exr")
    with pytest.raises(NgptError, match=r"a\.exr: no layer 'dx'; the stack holds primal, albedo; .*--layer dx=NAME"):
        stack["dx"]
    with pytest.raises(NgptError, match=r"a\.exr: method 'l1' needs layers 'dx' and 'dy'; .*dx=NAME --layer dy=NAME"):
        stack.require("primal", "dx", "dy", why="method 'l1'")
    stack.attributes["ngpt:sampler"] = "primal"
    with pytest.raises(NgptError, match="sampler primal renders no gradients"):
        stack.require("dy", why="method 'l1'")
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
