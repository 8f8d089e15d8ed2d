"""Scenes of light through masks and panes, from lamps with a size and without."""

import mitsuba as mi
import numpy as np
from data_gen_scenes import _diffuse, _light, _rgb, _room, _scene, _sphere, _two, _wall

_BESIDE = ([0.3, 1.25, 3.9], [0, 0.9, 0], 50)


def _mask(opacity, *colour):
    return {"type": "mask", "opacity": opacity, "nested": _two(*colour)}


def curtains(depth=-1):
    """The sun, a bulb without size, and two lamps with a size, behind masks one behind the other, seen through one."""
    checks = {"type": "checkerboard", "color0": 0.2, "color1": 0.9}
    pane = {"type": "thindielectric", "specular_transmittance": _rgb(0.9, 0.6, 0.3)}
    return _scene(
        depth,
        _BESIDE,
        # Gloss: the density of a direction depends on where a path comes from.
        **_room(1.5, {"type": "roughconductor", "alpha": 0.25, "specular_reflectance": 0.6}),
        sky={"type": "constant", "radiance": 0.05},
        sun={"type": "directional", "direction": [0.25, -1, -0.6], "irradiance": _rgb(3, 2.5, 2)},
        bulb={"type": "point", "position": [-1.0, 1.9, 0.9], "intensity": _rgb(1, 1.5, 2)},
        lamp=_light([0.4, 2.3, 0.2], [0, -1, 0], (0.5, 0.5), (9, 8, 7)),
        globe=_sphere([1.0, 1.9, 0.6], 0.12, _diffuse(0, 0, 0)) | {"emitter": {"type": "area", "radiance": 12.0}},
        high=_wall([0, 1.7, 0.2], [0.1, 1, 0], (2.6, 2.2), _mask(0.4, 0.7, 0.5, 0.4)),
        low=_wall([0.2, 1.2, 0.1], [0, 1, 0.2], (2.2, 2.0), _mask(checks, 0.3, 0.6, 0.4)),
        pane=_wall([-0.4, 0.6, 0.3], [-0.2, 1, 0.3], (1.2, 1.2), pane),
        veil=_wall([-0.5, 0.9, 1.4], [0.1, 0, 1], (1.2, 1.4), _mask(0.5, 0.3, 0.4, 0.8)),
    )


def few_edges():
    """Of paths that end while they are among the holes."""
    return curtains(4)


def curtains_in_fog():
    """The same, in a box of fog."""
    air = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3}
    place = mi.ScalarTransform4f().translate([0, 1.2, 0]).scale([1.4, 1.15, 1.45])
    scene = curtains() | {"box": {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": air}}
    return scene | {"integrator": {"type": "volpath", "max_depth": -1}}


def leaves(number=24):
    """The sun through many leaves one behind the other, over a floor, which is seen through them too."""
    tiles = {"type": "checkerboard", "color0": 1.0, "color1": 0.0}
    tiles["to_uv"] = mi.ScalarTransform4f().scale([3, 3, 1])
    rng = np.random.default_rng(5)
    scene = _scene(
        -1,
        ([0, 1.6, 3.5], [0, 0.4, 0], 50),
        sun={"type": "directional", "direction": [0.2, -1, -0.3], "irradiance": _rgb(3, 2.5, 2)},
        floor=_wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.5, 0.5, 0.5)),
    )
    leaf = {"type": "mask", "opacity": tiles, "nested": _two(0.3, 0.6, 0.2)}
    for i in range(number):
        x, z = rng.uniform(-1, 1, 2)
        scene[f"leaf_{i}"] = _wall([x, 0.3 + 1.2 * i / number, z], [0.1, 1, 0.3 * (-1) ** i], (0.9, 0.9), leaf)
    return scene
