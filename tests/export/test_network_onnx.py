"""Networks as ONNX: the same as in PyTorch, whole and in tiles, whatever goes in."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxscript")
torch = pytest.importorskip("torch")

# ruff: noqa: E402
import onnx
import onnxruntime
from full_stack import full_layers
from networks import ALL, GRAPHED, untrained
from scipy.ndimage import uniform_filter

from export.__main__ import main
from ngpt.export.network import network_model, statistics_model
from ngpt.export.vector import example_layers, quiet
from ngpt.methods import reconstruct
from ngpt.network import inputs
from ngpt.network.exposure import statistics
from ngpt.network.features import exposure
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.shipped import WEIGHTS
from ngpt.network.weights import save_weights
from ngpt.repair import repair
from ngpt.stack import GradientStack

FAST = Path(__file__).parents[2] / "export" / "weights" / "ngpt-fast.safetensors"


def session(model):
    """Of a model, or of a file."""
    source = model if isinstance(model, Path) else model.SerializeToString()
    return onnxruntime.InferenceSession(source, quiet(), providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def fast():
    return session(onnx.load(WEIGHTS / "ngpt-fast.onnx"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of untrained weights, none of which is zero."""
    folder = tmp_path_factory.mktemp("weights")
    for name, config in GRAPHED.items():
        save_weights(folder / f"{name}.safetensors", untrained(config), {})
    return folder


def noisy(height, width, scale=1.0, seed=0):
    """All layers of a stack, (1, C, H, W)."""
    layers = full_layers(height, width, scale, seed)
    layers["direct"] = layers["caustic"] = np.zeros_like(layers["primal"])
    layers["caustic_var"] = layers["direct"] - 1
    return {name: np.ascontiguousarray(layer.transpose(2, 0, 1)[None]) for name, layer in layers.items()}


def stack_of(layers):
    return GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})


def in_torch(layers, path):
    stack = stack_of(layers)
    return reconstruct(stack, "ngpt", weights=str(path)).image.transpose(2, 0, 1)[None]


def run(session, layers, **more):
    names = [i.name for i in session.get_inputs()]
    return session.run(None, {name: layers[name] for name in names if name in layers} | more)[0]


def assert_close(ours, theirs, tolerance=1e-4):
    assert np.isfinite(ours).all()
    # Relative to each value, and for the darkest to a hundredth of the largest.
    assert (np.abs(ours - theirs) <= tolerance * (np.abs(theirs) + 1e-2 * np.abs(theirs).max())).all()


# Weights at random make rounding grow where a pyramid is drawn to gradients.
TOLERANCE = {"a pyramid drawn to gradients": 1e-3}
# Of what others have parts of
MORE = ("with a choice", "relative to its base", "converging", "halved by maxima", "halved by lines")


@pytest.fixture(scope="module", params=[pytest.param(n, marks=pytest.mark.slow) if n in MORE else n for n in GRAPHED])
def pair(request, weights):
    """A file of weights and its ONNX session."""
    path = weights / f"{request.param}.safetensors"
    return path, session(network_model(path, request.param))


@pytest.fixture
def other_denoiser(monkeypatch):
    """In OIDN's place, which is not everywhere: a blur. Returns the images a combiner is given of it."""
    monkeypatch.setattr(inputs, "oidn", lambda data, *_: uniform_filter(data.image, (3, 3, 1)))

    def images(layers):
        data = repair(stack_of(layers))
        made = inputs.denoised(inputs.Oidn(data), inputs.base_image(data, "wcv"), inputs.DENOISED)
        return {name: np.ascontiguousarray(image.transpose(2, 0, 1)[None]) for name, image in made.items()}

    return images


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (17, 16), (37, 53)])
def test_the_same_as_in_torch(pair, size, other_denoiser):
    path, onnx_session = pair
    layers = noisy(*size)
    assert_close(
        run(onnx_session, layers | other_denoiser(layers)), in_torch(layers, path), TOLERANCE.get(path.stem, 1e-4)
    )


@pytest.mark.parametrize("size", [(1, 1), (17, 16), (37, 53), (64, 48)])
def test_the_shipped_file_is_that_of_the_shipped_weights(fast, size):
    layers = noisy(*size)
    assert_close(run(fast, layers), in_torch(layers, FAST))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ngpt-fast", "ngpt-combine", "ngpt-primal"])
def test_an_export_of_today_gives_what_the_shipped_file_gives(name):
    layers = noisy(37, 53)
    layers |= {other: k * layers["primal"] for other, k in (("denoised", 0.98), ("denoised_base", 0.99))}
    today, shipped = (
        session(network_model(FAST.with_name(f"{name}.safetensors"), name)),
        session(WEIGHTS / f"{name}.onnx"),
    )
    assert np.abs(run(today, layers) - run(shipped, layers)).max() <= 1e-6 * run(shipped, layers).max()


def test_the_same_with_a_scene_that_has_unknown_variances_and_extreme_pixels(fast):
    layers = noisy(40, 33)
    layers["primal"][0, :, 10, 12] = 1e6
    layers["primal_var"][0, :, 20:24, 8:12] = np.nan
    layers["dx_var"][0, 1, 5, 5] = -1
    layers["dy_var"][0, 2, 30, 9] = np.inf
    assert_close(run(fast, layers), in_torch(layers, FAST), 1e-3)


@pytest.mark.parametrize("value", [0.0, 1e-12, 65504.0, 1e12])
def test_extremes(fast, value):
    ours = run(fast, noisy(19, 24, value))
    assert np.isfinite(ours).all()
    # In proportion to what goes in: exactly, since powers of two are.
    layers = noisy(19, 24, 1.0)
    for k in (2.0**-30, 2.0**30):
        scaled = noisy(19, 24, k)
        assert_close(run(fast, scaled) / np.float32(k), run(fast, layers), 1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["primal", "dx", "dy", "albedo", "normal", "depth", "primal_var", "dx_var", "dy_var"])
def test_values_that_are_not_finite_stay_where_they_are(fast, name, bad):
    layers = noisy(160, 24)
    whole = run(fast, layers)
    layers[name][0, 0, 3, 4] = bad
    harmed = run(fast, layers)
    assert np.isfinite(harmed).all()
    far = np.abs(harmed - whole)[0, :, 130:]
    assert far.max() <= 0.02 * whole.mean()


@pytest.mark.parametrize("name", ["with a base", "as published"])
def test_tiles_of_a_host_make_the_whole(weights, name):
    """What CONTRACT.md tells a host to do, literally."""
    path = weights / f"{name}.safetensors"
    model = network_model(path, name)
    tell = {item.key: item.value for item in model.metadata_props}
    alignment, margin = int(tell["ngpt.alignment"]), int(tell["ngpt.overlap"])
    onnx_session, layers = session(model), noisy(50, 290)
    shared = run(session(statistics_model(path, name)), layers)
    whole, tiled = run(onnx_session, layers), np.zeros((1, 3, 50, 290), np.float32)
    step = 20 * alignment
    for x in range(0, 290, step):
        begin = max(x - margin, 0)
        part = {key: layer[..., begin : x + step + margin].copy() for key, layer in layers.items()}
        image = run(onnx_session, part, statistics=shared)
        tiled[..., x : x + step] = image[..., x - begin : x - begin + step]
    assert_close(tiled, whole, 2e-5)
    wrong = run(onnx_session, {key: layer[..., :100].copy() for key, layer in layers.items()})
    assert np.abs(wrong[..., :40] - whole[..., :40]).max() > 1e-4 * whole.mean(), "statistics would not matter"


@pytest.mark.parametrize("size", [(1, 1), (16, 32), (37, 300), (700, 9)])
@pytest.mark.parametrize("scale", [0.0, 1.0, 1e9])
def test_statistics_are_the_same_by_the_graph_in_numpy_and_in_torch(size, scale):
    layers = noisy(*size, scale)
    layers["primal"][0, :, 0, 0] *= -1
    graph = run(onnxruntime.InferenceSession(WEIGHTS / "ngpt-fast.statistics.onnx", quiet()), layers)
    ours = statistics({name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})
    assert np.allclose(ours[:4], graph[:4], rtol=1e-5)
    assert np.isclose(ours[0], float(exposure(torch.from_numpy(layers["primal"]))), rtol=1e-5)


def test_several_tiles_in_one_run(fast):
    a, b = noisy(30, 20, seed=1), noisy(30, 20, seed=2)
    statistics = np.array([0.1, 5, 0, 8, 0.05], np.float32)
    both = {name: np.concatenate([a[name], b[name]]) for name in a}
    together = run(fast, both, statistics=statistics)
    assert_close(together[:1], run(fast, a, statistics=statistics), 1e-5)


def test_the_overlap_is_as_far_as_light_goes_that_gradients_do_not_hold(weights):
    """Over surfaces that are alike. Measured: what lies beyond does not matter, and half of it would be too little."""
    path = weights / "as published.safetensors"
    model = network_model(path, "m")
    onnx_session, layers = session(model), noisy(9, 160)
    layers |= {feature: 0 * layers[feature] + 0.5 for feature in ("albedo", "normal", "depth")}
    statistics = np.array([0.1, 5, 0, 8, 0.05], np.float32)
    before = run(onnx_session, layers, statistics=statistics)
    layers["caustic"] = np.where(np.arange(160) < 80, 0, np.ones_like(layers["primal"]))
    layers["primal"] = layers["primal"] + layers["caustic"]
    changed = np.abs(run(onnx_session, layers, statistics=statistics) - before).max(axis=(0, 1, 2)) > 0
    reach = 80 - int(np.argmax(changed))
    margin = int({item.key: item.value for item in model.metadata_props}["ngpt.overlap"])
    assert margin // 2 < reach <= margin


def test_metadata_tell_all_and_nothing_of_this_machine():
    file = WEIGHTS / "ngpt-fast.onnx"
    model = onnx.load(file)
    tell = {item.key: item.value for item in model.metadata_props}
    assert tell["ngpt.inputs"].split(", ")[:4] == ["primal", "direct", "dx", "dy"]
    assert json.loads(tell["ngpt.training"])["step"] > 0
    assert str(Path.cwd()).encode() not in file.read_bytes() and b"site-packages" not in file.read_bytes()
    assert not any(initializer.external_data for initializer in model.graph.initializer)


def test_the_vector_is_that_of_the_shipped_network(fast):
    folder = Path(__file__).parents[2] / "export/vector"
    listing = json.loads((folder / "layers.json").read_text())
    arrays = {}
    for name, entry in listing.items():
        data = (folder / f"{name}.f32").read_bytes()
        assert hashlib.sha256(data).hexdigest() == entry["sha256"]
        arrays[name] = np.frombuffer(data, "<f4").reshape(entry["shape"])
    assert all(
        np.allclose(arrays[name], layer, equal_nan=True) for name, layer in example_layers().items() if name in arrays
    )
    assert_close(run(fast, arrays), arrays["image"])


def test_command(tmp_path, weights, capsys):
    output, path = tmp_path / "m.onnx", weights / "as published.safetensors"
    command = ["--weights", str(path), "-o", str(output)]
    assert main([*command, "--vector", str(tmp_path / "vector")]) == 0
    # Hosts look for it there.
    assert onnxruntime.InferenceSession(tmp_path / "m.statistics.onnx", quiet()).get_outputs()[0].shape == [5]
    listing = json.loads((tmp_path / "vector/layers.json").read_text())
    assert set(listing) == {*ALL, "direct", "caustic", "caustic_var", "image"}
    assert main(command) == 1 and "m.onnx" in capsys.readouterr().err
    output.unlink()
    assert main(command) == 1 and "m.statistics.onnx: exists already" in capsys.readouterr().err
    assert not output.exists()
    assert main(["--weights", str(tmp_path / "none.safetensors"), "-o", str(tmp_path / "n.onnx")]) == 1
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "n.onnx").exists()


def test_a_base_without_a_graph_is_refused(tmp_path, capsys):
    config = ModelConfig("plain", (4, 4), (), ("primal", "dx", "dy", "base"), "l2")
    save_weights(tmp_path / "w.safetensors", Reconstructor(config), {})
    assert main(["--weights", str(tmp_path / "w.safetensors"), "-o", str(tmp_path / "m.onnx")]) == 1
    assert "'l2'" in capsys.readouterr().err
