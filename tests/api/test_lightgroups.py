"""Light groups: found by the names of renderers, denoised, and still adding up to the whole."""

import numpy as np
import pytest

import ngpt
from ngpt.api import lightgroups
from ngpt.errors import NgptError
from ngpt.io.openexr import ExrImage, ExrPart, write_exr


@pytest.fixture
def lights(rng):
    """Two lights from left and right with noise, 40x24, and albedo; what has no noise of each."""
    y, x = np.mgrid[0:24, 0:40] / 40
    clean = {
        "Key": np.stack([1 - x, 0.8 * (1 - x), 0.5 * (1 - x)], axis=-1) * (y[..., None] > 0.2),
        "Fill": np.stack([0.2 * x, 0.3 * x, 0.6 * x], axis=-1) * (x[..., None] > 0.4),
    }
    noisy = {name: (light * rng.gamma(4, 0.25, light.shape)).astype(np.float32) for name, light in clean.items()}
    return clean, noisy


def written(path, layers, header=None, type=np.float32):
    """A file with these layers: name -> (H, W, 3)."""
    channels = {}
    for name, image in layers.items():
        for i, c in enumerate("RGB"):
            channels[f"{name}.{c}" if name else c] = np.ascontiguousarray(image[..., i], type)
    write_exr(path, ExrImage([ExrPart("", dict(header or {}), channels)]))
    return path


def cycles(path, noisy, more=(), **options):
    layers = {"ViewLayer.Combined": sum(noisy.values())} | dict(more)
    return written(path, layers | {f"ViewLayer.Combined_{name}": light for name, light in noisy.items()}, **options)


@pytest.mark.parametrize("method", ["auto", "nfor", "primal"])
def test_groups_add_up_to_the_result(lights, tmp_path, method, command):
    clean, noisy = lights
    cycles(tmp_path / "render.exr", noisy)
    command(f"denoise render.exr -o out.exr -m {method} --groups")
    result, denoised = ngpt.read_image("out.exr"), lightgroups.layers_of_light(ngpt.read("out.exr"))
    parts = {name: denoised[f"ViewLayer.Combined_{name}"] for name in clean}
    assert np.abs(sum(part.astype(np.float64) for part in parts.values()) - result).max() <= 1e-5 * np.abs(result).max()
    for name, light in clean.items():
        before, after = (np.mean((image - light) ** 2) for image in (noisy[name], parts[name]))
        assert method == "primal" or after < 0.5 * before, name


def test_shares_keep_the_sum_and_the_sign(rng):
    parts = rng.random((3, 8, 9, 3)) * (rng.random((3, 8, 9, 3)) > 0.5)
    parts[:, 2, 3] = 0
    whole = (rng.random((8, 9, 3)) * 1e4).astype(np.float32)
    shared = lightgroups.shares(list(parts), whole)
    assert np.abs(np.sum(shared, axis=0, dtype=np.float64) - whole).max() <= 1e-5 * whole.max()
    assert np.min(shared) >= 0
    assert np.allclose(shared[0][2, 3], whole[2, 3] / 3)


def test_a_method_that_needs_gradients_gives_way_to_one_that_groups_allow(lights, noisy_stack):
    stack, _ = noisy_stack
    half = {"a": 0.25 * stack["primal"], "b": 0.75 * stack["primal"]}
    whole = ngpt.denoise(stack, "l1")
    parts = lightgroups.denoised(stack, half, whole, "l1", alpha=0.3)
    assert np.abs(parts["a"] + parts["b"] - whole).max() < 1e-5 * whole.max()


def test_groups_are_found_by_the_names_of_renderers(lights, tmp_path):
    _, noisy = lights
    key, fill = noisy.values()
    arnold = written(tmp_path / "arnold.exr", {"": key + fill, "RGBA_key": key, "RGBA_default": fill, "coat": key})
    assert set(lightgroups.find(ngpt.read(arnold))) == {"RGBA_key", "RGBA_default"}
    own = written(tmp_path / "own.exr", {"": key + fill, "light_a": key, "light_b": fill})
    assert set(lightgroups.find(ngpt.read(own), ["light_*"])) == {"light_a", "light_b"}
    with pytest.raises(NgptError, match=r"no light groups called Combined_\* or RGBA_\*; .*: light_a, light_b"):
        lightgroups.find(ngpt.read(own))


def test_all_else_in_the_file_stays_and_types_too(lights, tmp_path, command):
    _, noisy = lights
    cycles(tmp_path / "half.exr", noisy, {"ViewLayer.Mist": noisy["Key"]}, type=np.float16)
    command("denoise half.exr -o out.exr -m nfor --groups")
    before, after = ngpt.read("half.exr"), ngpt.read("out.exr")
    assert np.array_equal(*(lightgroups.layers_of_light(s)["ViewLayer.Mist"] for s in (before, after)))
    assert after.source.image.parts[0].channels["ViewLayer.Combined_Key.R"].dtype == np.float16
    assert after.attributes["ngpt:groups"] == "ViewLayer.Combined_Fill, ViewLayer.Combined_Key"
    with pytest.raises(NgptError, match="denoised already"):
        lightgroups.find(after)


def test_groups_of_every_view_are_denoised(lights, tmp_path, command):
    _, noisy = lights
    layers = {"": sum(noisy.values())} | {f"RGBA_{name}": light for name, light in noisy.items()}
    both = layers | {f"right.{name}" if name else "right": np.flip(light, 1) for name, light in layers.items()}
    written(tmp_path / "stereo.exr", both, {"multiView": ["left", "right"]})
    command("denoise stereo.exr -o out.exr -m nfor --groups")
    for view in ("left", "right"):
        parts = lightgroups.layers_of_light(ngpt.read("out.exr", view=view))
        groups = [parts[name] for name in parts if "RGBA_" in name]
        result = ngpt.read_image("out.exr", view=view)
        assert len(groups) == 2, parts.keys()
        assert np.abs(sum(groups) - result).max() <= 1e-5 * result.max(), view
