"""The C library makes the image that Python makes: whole and in tiles, from pixels that lie anywhere."""

import numpy as np
import pytest
from capi import WEIGHTS, Network, agree, example, in_python, result, those

NETWORKS = [path for path in sorted(WEIGHTS.glob("ngpt-*.onnx")) if not path.stem.endswith(".statistics")]


@pytest.fixture(scope="module", params=NETWORKS, ids=lambda path: path.stem)
def both(library, request):
    return Network(library, request.param), in_python(request.param)


@pytest.mark.parametrize("size", [(23, 29), (1, 1), (1, 40)])
def test_networks_agree_with_python(both, size):
    network, python = both
    layers = those(network, example(*size))
    agree(result(network, layers), python(layers))


def test_tiles_agree_with_the_whole_and_may_be_written_where_a_layer_is(fast):
    layers = those(fast, example(23, 700))
    whole, tiled = result(fast, layers), result(fast, layers, 30)
    agree(tiled, whole)
    np.testing.assert_array_equal(result(fast, layers, 30, image=layers["primal"]), tiled)


# --- where pixels lie ------------------------------------------------------------------------------------------------


def odd_address(array):
    room = np.zeros(array.nbytes + 1, np.uint8)[1:].view()
    room[:] = np.frombuffer(array.tobytes(), np.uint8)
    return np.ndarray(array.shape, array.dtype, room.data)


LAYOUTS = {
    "planes": lambda a: np.moveaxis(np.ascontiguousarray(np.moveaxis(a, -1, 0)), 0, -1),
    "from the bottom": lambda a: np.ascontiguousarray(a[::-1])[::-1],
    "part of a larger image": lambda a: np.pad(a, [(2, 3), (3, 4), (0, 1)])[2:-3, 3:-4, :-1],
    "more channels": lambda a: np.concatenate([a, np.full_like(a[..., :1], 99)], axis=-1),
    "odd addresses": odd_address,
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_give_the_same(primal, layout):
    layers = those(primal, example())
    expected = result(primal, layers)
    before = {name: layout(layer) for name, layer in layers.items()}
    given = {name: layer.copy() for name, layer in before.items()}
    image = layout(np.full(expected.shape, 7, np.float32))
    np.testing.assert_array_equal(result(primal, before, image=image)[..., :3], expected)
    assert (image[..., 3:] == 99).all()
    for name in given:
        np.testing.assert_array_equal(before[name], given[name])


def test_halves(primal):
    every = np.arange(2**16, dtype=np.uint16).view(np.float16)
    halves = np.resize(np.where(np.isfinite(every), every, 0), (683, 32, 3))
    others = those(primal, example(683, 32))
    expected = result(primal, others | {"primal": halves.astype(np.float32)})
    np.testing.assert_array_equal(result(primal, others | {"primal": halves}), expected)
    image = result(primal, others | {"primal": halves}, image=np.zeros(halves.shape, np.float16))
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(image, expected.astype(np.float16))
