"""Paths that end in a cache find the light of whole paths: in rooms of each material, and in each kind of medium."""

import gc
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from media_scenes import coloured_smoke, colours, filled, hovering, milk, nested, wisps
from shared_tails import SIZE, Bias, blocks, images, whole_paths
from tails_scenes import of_material
from unbiased import load

pytestmark = pytest.mark.usefixtures("small_images_share")


def _picture(*pixels):
    """A small picture, raw, of grey values or normals, repeated over the surface."""
    data = np.array(pixels, np.float32).reshape(2, 2, -1)
    to_uv = mi.ScalarTransform4f().scale([8, 8, 1])
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "to_uv": to_uv}


def _checks():
    colours = {"color0": {"type": "rgb", "value": 0.0}, "color1": {"type": "rgb", "value": 0.8}}
    return {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([30, 30, 1]), **colours}


GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}
MATERIALS = {
    "black and white checks": lambda: {"type": "diffuse", "reflectance": _checks()},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": 0.6},
    "rough plastic": lambda: {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.6},
    "principled": lambda: {"type": "principled", "roughness": 0.5, "metallic": 0.4, "spec_trans": 0.0, "sheen": 0.5},
    "principled glass": lambda: {"type": "principled", "roughness": 0.5, "spec_trans": 0.5},
    "leaf": lambda: {"type": "principledthin", "roughness": 0.5, "diff_trans": 0.8},
    "mirror and grey": lambda: {"type": "blendbsdf", "weight": 0.2, "grey": GREY, "mirror": {"type": "conductor"}},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "grey": GREY},
    "two-sided": lambda: {"type": "twosided", "front": GREY, "back": {"type": "plastic"}},
    "bumps": lambda: {"type": "bumpmap", "bumps": _picture(0, 0.02, 0.02, 0), "grey": GREY},
    # Some are tilted by 70 degrees, so they scatter nothing into some directions of a matt surface.
    "normals": lambda: {
        "type": "normalmap",
        "normalmap": _picture((0.97, 0.5, 0.67), (0.03, 0.5, 0.67), (0.5, 0.97, 0.67), (0.5, 0.5, 1)),
        "grey": GREY,
    },
}
PHASES = {
    "isotropic": {"type": "isotropic"},
    "rayleigh": {"type": "rayleigh"},
    "backward": {"type": "hg", "g": -0.5},
    "far forward": {"type": "hg", "g": 0.8},
    "table": {"type": "tabphase", "values": "1, 1, 1"},
}
MEDIA = {name: filled({"albedo": 0.95, "sigma_t": 0.6, "phase": phase}) for name, phase in PHASES.items()}
MEDIA |= {scene.__name__: scene for scene in (nested, milk, hovering, coloured_smoke, wisps)} | {"colours": colours}

# The others scatter like one of these.
QUICK = {
    "plastic",
    "leaf",
    "mirror and grey",
    "black and white checks",
    "normals",
    "backward",
    "nested",
    "milk",
    "colours",
    "wisps",
}
MARKS = {name: [] if name in QUICK else [pytest.mark.slow] for name in [*MATERIALS, *MEDIA]}
# Mitsuba hides the table from Dr.Jit. Whole paths have the same problem.
MARKS["table"].append(pytest.mark.recorded_anew)


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks) for name, marks in MARKS.items()])
def test_each_material_and_medium_keeps_its_light(renderer, monkeypatch, name):
    monkeypatch.setattr("data_gen.samplers.gpt.rounds._PAYS", 0)
    # Kernels call the phase functions of all scenes in memory, and cannot be recorded if some belong to no scene.
    gc.collect()
    scene = MEDIA[name] if name in MEDIA else partial(of_room, name)
    found = Bias(blocks(images(load(mi, scene, SIZE), "shared", 128, range(4))), whole_paths(scene))
    assert (np.abs(found.total) < 4 * found.doubt + 2e-3).all()
    # Media are noisier.
    assert found.square < 0.01**2 + (3 * found.doubt_of_square if name in MEDIA else 0)


def of_room(name):
    return of_material(MATERIALS[name]())
