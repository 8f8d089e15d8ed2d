"""Paths that end in a cache, by material: with each of Mitsuba's, the light of a room is that of whole paths."""

import mitsuba as mi
import numpy as np
import pytest
from tails_scenes import SIZE, of_material
from unbiased import REFERENCES, load

from data_gen.render import render_stack
from data_gen.tails import schedule


def _checks(*colour):
    dark = {"type": "rgb", "value": list(colour)}
    light = {"type": "rgb", "value": [0.8, 0.8, 0.8]}
    return {
        "type": "checkerboard",
        "color0": dark,
        "color1": light,
        "to_uv": mi.ScalarTransform4f().scale([30, 30, 1]),
    }


def _picture(*pixels):
    """A small picture, raw, of grey values or normals, repeated over the surface."""
    data = np.array(pixels, np.float32).reshape(2, 2, -1)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(data),
        "raw": True,
        "to_uv": mi.ScalarTransform4f().scale([8, 8, 1]),
    }


GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}
METAL = {"type": "roughconductor", "alpha": 0.16, "material": "Al"}
MATERIALS = {
    "black and white checks": lambda: {"type": "diffuse", "reflectance": _checks(0.0, 0.0, 0.0)},
    "red and white checks": lambda: {"type": "diffuse", "reflectance": _checks(0.8, 0.0, 0.0)},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": 0.6},
    "rough plastic": lambda: {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.6},
    "principled": lambda: {"type": "principled", "roughness": 0.5, "metallic": 0.4, "spec_trans": 0.0, "sheen": 0.5},
    "principled glass": lambda: {"type": "principled", "roughness": 0.5, "spec_trans": 0.5},
    "leaf": lambda: {"type": "principledthin", "roughness": 0.5, "diff_trans": 0.8},
    "metal and grey": lambda: {"type": "blendbsdf", "weight": 0.9, "grey": GREY, "metal": METAL},
    "plastic and grey": lambda: {"type": "blendbsdf", "weight": 0.5, "grey": GREY, "plastic": {"type": "plastic"}},
    "mirror and grey": lambda: {"type": "blendbsdf", "weight": 0.2, "grey": GREY, "mirror": {"type": "conductor"}},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "grey": GREY},
    "two-sided": lambda: {"type": "twosided", "front": GREY, "back": {"type": "plastic"}},
    "bumps": lambda: {"type": "bumpmap", "bumps": _picture(0, 0.02, 0.02, 0), "grey": GREY},
    # Some tilted by 70 degrees: where they scatter nothing a matt surface does.
    "normals": lambda: {
        "type": "normalmap",
        "normalmap": _picture((0.97, 0.5, 0.67), (0.03, 0.5, 0.67), (0.5, 0.97, 0.67), (0.5, 0.5, 1)),
        "grey": GREY,
    },
}
SLOW = ("principled glass", "plastic and grey", "two-sided", "bumps", "red and white checks")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in MATERIALS]
)
def test_each_material_keeps_its_light(renderer, monkeypatch, name):
    """In the mean and in blocks of 4x4 pixels, of 256 samples and four seeds."""
    monkeypatch.setattr(schedule, "BEGIN", 1)
    scene = load(renderer, of_material(MATERIALS[name]()), SIZE)
    found = {}
    for tails, first in (("shared", 0), ("paths", REFERENCES)):
        how = {"tails": tails, "with_features": False}
        stacks = [render_stack(scene, 256, first + seed, "primal", unbiased=True, **how) for seed in range(4)]
        found[tails] = np.array([stack["primal"] for stack in stacks], np.float64)
    assert stacks[0].attributes.get("ngpt:tails") is None
    shared, whole = (image.reshape(4, 6, 4, 8, 4, 3).mean(axis=(2, 4)) for image in found.values())
    doubt = [np.sqrt(each.mean(axis=(1, 2)).var(axis=0, ddof=1) / 4) for each in (shared, whole)]
    error = shared.mean(axis=(0, 1, 2)) - whole.mean(axis=(0, 1, 2))
    assert (np.abs(error) < 4 * np.hypot(*doubt) + 2e-3 * whole.mean()).all()
    # Products of independent differences have no noise in their mean.
    halves = [shared[i::2].mean(axis=0) - whole[i::2].mean(axis=0) for i in range(2)]
    unit = whole.mean(axis=0) + 0.02 * whole.mean()
    assert (halves[0] * halves[1] / unit**2).mean() < 0.01**2
