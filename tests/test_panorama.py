"""Images of 360 degrees: no method leaves a seam between their borders."""

from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from exr_files import read_raw
from full_stack import full_layers

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.methods import METHODS, reconstruct
from ngpt.panorama import WRAP, wraps
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

USABLE = [name for name, entry in METHODS.items() if not entry.missing() and entry.standing != "study"]
LATLONG = {"envmap": OpenEXR.ENVMAP_LATLONG}


@pytest.fixture(scope="module")
def panorama():
    """The layers of one, 24x160, that is brightest at its borders."""
    rng = np.random.default_rng(1)
    clean = np.zeros((24, 160, 3)) + (1 + 0.8 * np.cos(2 * np.pi * (np.arange(160) + 0.5) / 160))[None, :, None]
    layers = full_layers(24, 160)
    dx, dy = forward_differences(clean)
    noise = {name: 0.05 * rng.normal(size=clean.shape) for name in ("dx", "dy")}
    layers |= {"primal": clean * rng.gamma(1, 1, (24, 160, 1)), "primal_var": clean**2, "dx": dx + noise["dx"]}
    layers |= {"dy": dy + noise["dy"], "dx_var": 0.0025 + 0 * clean, "dy_var": 0.0025 + 0 * clean}
    layers |= {"albedo": 0.5 + 0 * clean, "normal": np.zeros_like(clean), "depth": np.ones((24, 160, 1))}
    return {name: layer.astype(np.float32) for name, layer in layers.items()}


def step(image):
    """Between the borders, of means over 8 rows."""
    bands = image.reshape(-1, 8, *image.shape[1:]).mean(axis=1)
    return float(np.abs(bands[:, 0] - bands[:, -1]).mean())


@pytest.mark.parametrize("method", USABLE)
def test_no_method_leaves_a_seam(panorama, method):
    plain, wrapped = (GradientStack(panorama, header) for header in ({}, LATLONG))
    result = reconstruct(wrapped, method)
    assert result.image.shape == plain["primal"].shape and result.image.flags.c_contiguous
    # As if the seam were in the middle, where no difference is known.
    turned = {name: np.roll(layer, 80, axis=1) for name, layer in panorama.items()}
    turned["dx"][:, 79] = np.nan
    middle = np.roll(reconstruct(GradientStack(turned), method).image, -80, axis=1)
    assert step(result.image) <= 1.25 * step(middle) + 0.01
    if method in ("oidn", "nfor", "ngpt-primal", "ngpt-combine"):
        assert step(result.image) < 0.7 * step(reconstruct(plain, method).image)


def test_what_wraps(panorama):
    stack = GradientStack(panorama)
    assert not wraps(stack) and not wraps(replace(stack, attributes={"envmap": OpenEXR.ENVMAP_CUBE}))
    assert wraps(replace(stack, attributes=LATLONG)) and wraps(replace(stack, attributes={WRAP: 1}))
    assert not wraps(replace(stack, attributes={"envmap": "of something"}))
    part = Place(Window(0, 0, 160, 24), Window(0, 0, 320, 24))
    assert not wraps(replace(stack, attributes=LATLONG, place=part))


def test_counts_are_of_the_image_alone(panorama):
    broken = panorama["primal"].copy()
    broken[3, 2] = np.nan
    plain = GradientStack(panorama | {"primal": broken})
    expected, found = (reconstruct(replace(plain, attributes=header), "l1") for header in ({}, LATLONG))
    assert (found.repaired, found.untrusted) == (expected.repaired, expected.untrusted) == (1, 4)


def test_from_python_and_from_the_command_line(panorama, tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image = panorama["primal"][:8]
    expected = reconstruct(GradientStack({"primal": image}, LATLONG), "nfor").image
    assert np.array_equal(ngpt.denoise(image, "nfor", wrap=True), expected)
    assert np.array_equal(ngpt.denoise(GradientStack({"primal": image}), "nfor", wrap=True), expected)
    ngpt.write("a.exr", image)
    command("denoise a.exr -m nfor --wrap -o b.exr")
    ((_, header, channels),) = read_raw("b.exr")
    assert header[WRAP] == 1 and np.array_equal(channels["R"], expected[..., 0])
