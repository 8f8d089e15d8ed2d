"""A scene for spectra: flint glass before stripes. `register` of ``data_gen.samplers.studies.spectral.glass`` comes
first."""

from __future__ import annotations

import mitsuba as mi
import numpy as np


def prism(material: str = "n-sf11") -> dict:
    """A prism, edges of 60°, and a ball before a wall of black and white stripes, under one lamp. Units are metres."""
    grey, glass = _diffuse(0.5), {"type": "dispersive", "material": material}
    stripes = {"type": "checkerboard", "color0": _rgb(0.05), "color1": _rgb(0.8)}
    stripes["to_uv"] = mi.ScalarTransform4f().scale([12, 1, 1])
    # Corners of the unit cube at -1 and 1: a rhombus, whose faces are 60° and 120° apart.
    rhombus = np.eye(4)
    rhombus[:3, 0], rhombus[:3, 1] = (0.3, 0, 0.3 * 3**0.5), (0.3, 0, -0.3 * 3**0.5)
    rhombus[:3, 2], rhombus[:3, 3] = (0, 0.7, 0), (-0.75, 0.75, 0.2)
    look_at = mi.ScalarTransform4f().look_at
    wide = mi.ScalarTransform4f().scale([3, 3, 1])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 10},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": look_at(origin=[0, 0.9, 4.2], target=[0, 0.75, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 96, "height": 64, "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]) @ wide,
            "bsdf": grey,
        },
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 1, -2]) @ wide,
            "bsdf": {"type": "diffuse", "reflectance": stripes},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": look_at(origin=[1.5, 3, 2], target=[0, 0.5, -1], up=[0, 1, 0]),
            "emitter": {"type": "area", "radiance": {"type": "d65", "scale": 6.0}},
        },
        "prism": {"type": "cube", "to_world": mi.ScalarTransform4f(rhombus), "bsdf": glass},
        "ball": {"type": "sphere", "center": [0.85, 0.6, 0.4], "radius": 0.6, "bsdf": glass},
    }


def _rgb(value: float) -> dict:
    return {"type": "rgb", "value": [value] * 3}


def _diffuse(value: float) -> dict:
    return {"type": "diffuse", "reflectance": _rgb(value)}
