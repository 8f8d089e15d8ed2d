"""Networks as ONNX: the same as in PyTorch, whole and in tiles, whatever goes in."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxscript")
torch = pytest.importorskip("torch")

# ruff: noqa: E402
import onnx
import onnxruntime
from full_stack import full_layers
from hosts import read_layers, stack_of
from networks import ALL, GRAPHED, plain, untrained
from scipy.ndimage import uniform_filter

from export.__main__ import main
from ngpt.export.network import network_model, statistics_model
from ngpt.export.vector import quiet
from ngpt.methods import reconstruct
from ngpt.network import inputs
from ngpt.network.exposure import statistics
from ngpt.network.features import exposure
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.safetensors import save_weights
from ngpt.network.shipped import WEIGHTS
from ngpt.repair import repair

ROOT = Path(__file__).parents[2]
FAST = ROOT / "export" / "weights" / "ngpt-fast.safetensors"


def session(model):
    """A session of a model or of a file."""
    source = model if isinstance(model, Path) else model.SerializeToString()
    return onnxruntime.InferenceSession(source, quiet(), providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def fast():
    return session(WEIGHTS / "ngpt-fast.onnx")


@cache
def exported(path):
    return network_model(path, path.stem)


# Together they have all inputs. The heads of the others are tested in test_graphs.py.
QUICK = ("with all", "as published")


@pytest.fixture(scope="module", params=[n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in GRAPHED])
def pair(request, tmp_path_factory):
    """A file of untrained weights, none of which is zero, and its ONNX session."""
    path = tmp_path_factory.mktemp("weights") / f"{request.param}.safetensors"
    save_weights(path, untrained(GRAPHED[request.param]), {})
    return path, session(exported(path))


def told(model):
    return {item.key.removeprefix("ngpt."): item.value for item in model.metadata_props}


def noisy(height, width, scale=1.0, seed=0):
    """All layers of a stack, (1, C, H, W)."""
    layers = full_layers(height, width, scale, seed)
    layers["direct"] = layers["caustic"] = np.zeros_like(layers["primal"])
    layers["caustic_var"] = layers["direct"] - 1
    return {name: np.ascontiguousarray(layer.transpose(2, 0, 1)[None]) for name, layer in layers.items()}


def damaged(height, width, scale=1.0, holes=True):
    """With a lamp, rare bright light that gradients do not hold, and values that are not finite, alone and in holes."""
    layers, rng = noisy(height, width, scale), np.random.default_rng(height)
    layers["direct"] = np.zeros_like(layers["primal"])
    layers["direct"][..., :2, : width // 2] = 30 * scale
    shape = layers["primal"].shape
    light = scale * np.where(rng.random((1, 1, height, width)) > 0.9, rng.gamma(0.3, 20, shape), 0).astype(np.float32)
    layers |= {"caustic": light, "caustic_var": np.where(light > 4 * scale, light**2, np.float32(0.1 * scale**2))}
    layers["caustic_var"][rng.random(shape) < 0.1] = -1
    layers["primal"] = layers["primal"] + layers["direct"] + light
    if holes:
        for layer in layers.values():
            layer[rng.random(layer.shape) < 0.03] = rng.choice(np.float32([np.nan, np.inf, -np.inf]))
        layers["primal"][..., height // 4 : -2, width // 3 : -1] = np.nan
        layers["primal"][..., 0, 0] = layers["direct"][..., 0, 0] = 1  # so that there is something to repair from
        layers["caustic"][..., 0, 0] = 0
    return layers


def extreme(height, width):
    layers = noisy(height, width)
    layers["primal"][0, :, 10, 12] = 1e6
    layers["primal_var"][0, :, 20:24, 8:12] = np.nan
    layers["dx_var"][0, 1, 5, 5], layers["dy_var"][0, 2, 30, 9] = -1, np.inf
    return layers


def planes(image):
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None])


def in_torch(layers, path):
    return planes(reconstruct(stack_of(layers), "ngpt", weights=str(path)).image)


def run(session, layers, **more):
    names = [i.name for i in (*session.get_inputs(), *session.get_overridable_initializers())]
    return session.run(None, {name: layers[name] for name in names if name in layers} | more)[0]


def assert_close(ours, theirs, tolerance=1e-4):
    """Relative to each value, and for the darkest to a hundredth of the largest."""
    least = 1e-2 * tolerance * np.abs(theirs).max()
    np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=least, equal_nan=False)


@pytest.fixture
def other_denoiser(monkeypatch):
    """In OIDN's place, which is not everywhere: a blur. Returns the images of it that a network may be given."""
    monkeypatch.setattr(inputs, "oidn", lambda data, *_: uniform_filter(data.image, (3, 3, 1)))

    def images(layers, config):
        data = repair(stack_of(layers), config.reads_gradients)
        base = inputs.base_image(data, config.base) if config.base else None
        by_oidn = inputs.Oidn(data)
        light = np.zeros_like(data.image) if data.caustic is None else by_oidn.of_caustic
        made = {name: image + data.direct for name, image in inputs.denoised(by_oidn, base, config.layers).items()}
        if "denoised" in made:
            made["denoised"] += light
        return {name: planes(image) for name, image in (made | {"denoised_caustic": light}).items()}

    return images


# Weights at random make rounding grow where a pyramid is drawn to gradients.
TOLERANCE = {"a pyramid drawn to gradients": 1e-3}


@pytest.mark.parametrize(("made", "size"), [(noisy, (1, 1)), (damaged, (37, 53))])
def test_the_same_as_in_torch(pair, size, made, other_denoiser):
    path, onnx_session = pair
    # What a network does not read, its graph cannot see, and in Python it would set surfaces apart.
    read = [given.name for given in onnx_session.get_inputs()]
    layers = {name: layer for name, layer in made(*size).items() if name in read}
    ours = run(onnx_session, layers | other_denoiser(layers, GRAPHED[path.stem]))
    assert_close(ours, in_torch(layers, path), TOLERANCE.get(path.stem, 1e-4))


@pytest.mark.parametrize(
    ("layers", "tolerance"),
    [(noisy(1, 1), 1e-4), (damaged(90, 75), 1e-4), (extreme(40, 33), 1e-3), (noisy(19, 24, 1e12), 1e-3)],
    ids=["one pixel", "damaged", "extreme", "bright"],
)
def test_the_shipped_file_is_that_of_the_shipped_weights(fast, layers, tolerance):
    assert_close(run(fast, layers), in_torch(layers, FAST), tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ngpt-fast", "ngpt-combine", "ngpt-primal"])
def test_an_export_of_today_gives_what_the_shipped_file_gives(name):
    layers = noisy(37, 53)
    layers |= dict.fromkeys(("denoised", "denoised_base", "denoised_caustic"), 0.9 * layers["primal"])
    models = exported(FAST.with_name(f"{name}.safetensors")), WEIGHTS / f"{name}.onnx"
    today, shipped = (run(session(model), layers) for model in models)
    assert np.abs(today - shipped).max() <= 1e-6 * shipped.max()


@pytest.mark.parametrize("k", [2.0**-30, 2.0**30])
def test_images_follow_the_exposure(fast, k):
    scaled = run(fast, damaged(19, 24, k, holes=False))
    assert_close(scaled / np.float32(k), run(fast, damaged(19, 24, holes=False)), 1e-3)


def test_values_that_are_not_finite_stay_where_they_are(fast):
    whole = run(fast, noisy(160, 24))
    for name in ("primal", "dx", "dy", "albedo", "normal", "depth", "primal_var", "dx_var", "dy_var"):
        for bad in (np.nan, np.inf, -np.inf):
            layers = noisy(160, 24)
            layers[name][0, 0, 3, 4] = bad
            harmed = run(fast, layers)
            assert np.isfinite(harmed).all(), (name, bad)
            assert np.abs(harmed - whole)[0, :, 130:].max() <= 0.02 * whole.mean(), (name, bad)


# Tiles


@pytest.mark.parametrize("pair", ["with all"], indirect=True)
def test_tiles_of_a_host_make_the_whole(pair, other_denoiser):
    """What CONTRACT.md tells a host to do, literally."""
    path, onnx_session = pair
    tell = told(exported(path))
    alignment, margin, layers = int(tell["alignment"]), int(tell["overlap"]), noisy(50, 290)
    layers |= other_denoiser(layers, GRAPHED[path.stem])
    shared = run(session(statistics_model(path, "m")), layers)
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
    graph = run(session(WEIGHTS / "ngpt-fast.statistics.onnx"), layers)
    ours = statistics({name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})
    assert np.allclose(ours[:4], graph[:4], rtol=1e-5)
    assert np.isclose(ours[0], float(exposure(torch.from_numpy(layers["primal"]))), rtol=1e-5)


@pytest.mark.parametrize("pair", ["as published"], indirect=True)
def test_the_overlap_is_as_far_as_light_goes_that_gradients_do_not_hold(pair):
    """Over surfaces that are alike. Measured: what lies beyond does not matter, and half of it would be too little."""
    path, onnx_session = pair
    layers, shared = noisy(9, 160), np.array([0.1, 5, 0, 8, 0.05], np.float32)
    layers |= {feature: 0 * layers[feature] + 0.5 for feature in ("albedo", "normal", "depth")}
    before = run(onnx_session, layers, statistics=shared)
    layers["caustic"] = np.where(np.arange(160) < 80, 0, np.ones_like(layers["primal"]))
    layers["primal"] = layers["primal"] + layers["caustic"]
    changed = np.abs(run(onnx_session, layers, statistics=shared) - before).max(axis=(0, 1, 2)) > 0
    margin = int(told(exported(path))["overlap"])
    assert margin // 2 < 80 - int(np.argmax(changed)) <= margin


# Files


def test_metadata_tell_all_and_nothing_of_this_machine():
    file = WEIGHTS / "ngpt-fast.onnx"
    model = onnx.load(file)
    assert told(model)["inputs"].split(", ")[:4] == ["primal", "direct", "dx", "dy"]
    assert json.loads(told(model)["training"])["step"] > 0
    assert str(Path.cwd()).encode() not in file.read_bytes() and b"site-packages" not in file.read_bytes()
    assert not any(initializer.external_data for initializer in model.graph.initializer)


def test_command(tmp_path, capsys):
    output, path = tmp_path / "m.onnx", tmp_path / "w.safetensors"
    save_weights(path, untrained(plain(ALL, channels=(4, 4))), {})
    command = ["--weights", str(path), "-o", str(output)]
    assert main([*command, "--vector", str(tmp_path / "vector")]) == 0
    # Hosts look for it there.
    assert session(tmp_path / "m.statistics.onnx").get_outputs()[0].shape == [5]
    assert set(read_layers(tmp_path / "vector")) == {*ALL, "direct", "caustic", "caustic_var", "image"}
    assert main(command) == 1 and "m.onnx" in capsys.readouterr().err
    output.unlink()
    assert main(command) == 1 and "m.statistics.onnx: exists already" in capsys.readouterr().err
    assert main(["--weights", str(tmp_path / "none.safetensors"), "-o", str(output)]) == 1
    assert "no such file" in capsys.readouterr().err and not output.exists()


def test_a_base_without_a_graph_is_refused(tmp_path, capsys):
    config = ModelConfig("plain", (4, 4), (), ("primal", "dx", "dy", "base"), "l2")
    save_weights(tmp_path / "w.safetensors", Reconstructor(config), {})
    assert main(["--weights", str(tmp_path / "w.safetensors"), "-o", str(tmp_path / "m.onnx")]) == 1
    assert "'l2'" in capsys.readouterr().err
