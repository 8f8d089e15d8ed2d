"""Materials with diffuse lobes and others, for the sampler ``split``."""

import mitsuba as mi
import numpy as np

from data_gen.scenes.builtin import _camera, _diffuse, _light, _rgb, _sphere, _wall


def coats(specular=1.0):
    """Materials with diffuse lobes and others; with ``specular`` 0 the others are black, the diffuse ones the same."""
    satin = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _rgb(0.6, 0.3, 0.1), "nonlinear": True}
    satin |= {"specular_reflectance": specular}
    gloss = {"type": "plastic", "diffuse_reflectance": _rgb(0.2, 0.5, 0.3), "specular_reflectance": specular}
    metal = {"type": "roughconductor", "material": "Cu", "alpha": 0.3} if specular else _diffuse(0, 0, 0)
    return {
        "satin": satin,
        "gloss": {"type": "twosided", "nested": gloss},
        "hole": {"type": "mask", "opacity": 0.6, "nested": satin},
        "blend": {"type": "blendbsdf", "weight": 0.4, "one": _diffuse(0.5, 0.4, 0.6), "two": metal},
    }


def shelf(materials, max_depth=5, more=None):
    """Balls of these materials on a floor under a large lamp."""

    def scene():
        places = zip((-1.05, -0.35, 0.35, 1.05), materials.items(), strict=False)
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": max_depth, "rr_depth": 3},
            "sensor": _camera([0, 0.9, 3.2], [0, 0.35, 0], 45),
            "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.5, 0.5, 0.5)),
            "lamp": _light([0, 2.2, 0.8], [0, -1, 0], (2, 2), (3, 3, 3)),
            **{name: _sphere([x, 0.33, 0], 0.33, bsdf) for x, (name, bsdf) in places},
            **(more or {}),
        }

    return scene


def principled(**values):
    base = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
    return {"type": "twosided", "nested": {"type": "principled", "base_color": base, "roughness": 0.4, **values}}


def everything():
    """All that light may meet first: coats, mirrors, glass, metal, principled materials, bumps."""
    relief = mi.Bitmap(np.random.default_rng(3).random((8, 8), np.float32))
    bump = {"type": "bitmap", "raw": True, "bitmap": relief}
    first = {**coats(), "paint": principled(metallic=0.2, clearcoat=0.5)}
    behind = {
        "mirror": {"type": "conductor"},
        "glass": {"type": "dielectric"},
        "frosted": {"type": "roughdielectric", "alpha": 0.2},
        "relief": {"type": "bumpmap", "texture": bump, "scale": 0.05, "nested": principled(metallic=0.5)["nested"]},
    }
    places = zip((-1, -0.3, 0.4, 1.1), behind.items(), strict=True)
    more = {name: _sphere([x, 1.0, -0.4], 0.33, bsdf) for x, (name, bsdf) in places}
    more["paint"] = _sphere([0, 0.2, 1.2], 0.2, first.pop("paint"))
    # Without it ``path`` loses light behind holes.
    more["sky"] = {"type": "constant", "radiance": 0.2}
    return shelf(first, more=more)()


def without_gloss():
    """The materials whose gloss is black, under lamps alone; the sky keeps ``path`` from losing light behind holes."""
    return shelf(coats(0.0), 2, {"sky": {"type": "constant", "radiance": 1e-9}})()
