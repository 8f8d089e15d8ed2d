"""Paths that end in a cache, by material: with each of Mitsuba's, the light of a room is that of whole paths."""

import mitsuba as mi
import numpy as np
import pytest
from kept_light import keeps_its_light
from tails_scenes import SIZE, of_material
from unbiased import load

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
# What is left of others is like what is left of one of the five that stay.
SLOW = ("principled", "principled glass", "rough plastic", "metal and grey", "plastic and grey", "two-sided", "bumps")
SLOW += ("black and white checks", "red and white checks")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in MATERIALS]
)
def test_each_material_keeps_its_light(renderer, monkeypatch, name):
    monkeypatch.setattr(schedule, "BEGIN", 1)
    keeps_its_light(load(renderer, of_material(MATERIALS[name]()), SIZE))
