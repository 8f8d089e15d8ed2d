"""Scenes with every kind of light, for the tests of bidirectional samplers: name -> description."""

import numpy as np
from data_gen_scenes import caustics, furnace, glass, hidden_lamp, plenty, polished
from renders import mi

from data_gen.scenes.builtin import _box, _camera, _diffuse, _light, _rgb, _sky, _sphere, _wall


def _stage(**lamps):
    """A corner with a metal ball, without lamps but those given."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "rr_depth": 3},
        "sensor": _camera([0, 0.8, 4], [0, 0.6, 0], 45),
        "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.6, 0.5, 0.4)),
        "wall": _wall([1.2, 1, 0], [-1, 0, 0], (6, 2), _diffuse(0.7, 0.2, 0.2)),
        "ball": _sphere([-0.4, 0.5, 0], 0.5, {"type": "roughconductor", "material": "Cu", "alpha": 0.2}),
        **lamps,
    }


def points():
    """What has no area, without glass: ``path`` cannot see its caustics."""
    toward = mi.ScalarTransform4f().look_at([-0.5, 2.5, 1.5], [0, 0.3, 0], [0, 0, 1])
    return _stage(
        point={"type": "point", "position": [0.5, 2, 1], "intensity": _rgb(4, 3, 2), "sampling_weight": 0.4},
        spot={"type": "spot", "to_world": toward, "intensity": _rgb(12, 9, 9), "cutoff_angle": 30},
        sun={"type": "directional", "direction": [0.3, -1, -0.5], "irradiance": _rgb(2, 2, 1.5)},
    )


def areas():
    """A textured rectangle, a sphere, a cylinder, a disk and a mesh."""

    def glows(*rgb):
        return {"emitter": {"type": "area", "radiance": _rgb(*rgb)}}

    texels = (np.random.default_rng(1).random((4, 4, 3)) ** 4 * 20).astype(np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    over = mi.ScalarTransform4f().look_at([0.9, 1.9, 0.8], [0, 0, 0], [0, 0, 1]).scale(0.2)
    return _stage(
        picture=_light([0.3, 2.3, 0], [0, -1, 0], (1.5, 1.5), (1, 1, 1))
        | {"emitter": {"type": "area", "radiance": picture}},
        bulb=_sphere([-0.9, 1.5, 0.5], 0.2, _diffuse(0.3, 0.3, 0.3)) | glows(9, 7, 5),
        tube={"type": "cylinder", "p0": [-0.8, 1.8, 0.2], "p1": [0.3, 1.9, 0.4], "radius": 0.08, **glows(8, 7, 5)},
        disk={"type": "disk", "to_world": over, **glows(15, 13, 10)},
        cube=_box([0.5, 0.2, 0.9], [0.2, 0.2, 0.2], 30, _diffuse(0.2, 0.2, 0.2)) | glows(2, 1, 3),
        glass=_sphere([0.6, 0.75, 0.3], 0.3, {"type": "dielectric"}),
    )


def sky():
    """An environment with a sun, a lamp before it, and choices of unequal weight."""
    bulb = _sphere([-0.3, 1.9, 0.5], 0.25, _diffuse(0.3, 0.3, 0.3))
    return _stage(
        sky={"type": "envmap", "bitmap": mi.Bitmap(_sky(16, 32)), "sampling_weight": 2.0},
        bulb=bulb | {"emitter": {"type": "area", "radiance": _rgb(9, 7, 5)}},
        glass=_sphere([0.6, 0.35, 0.6], 0.3, {"type": "dielectric"}),
    )


def hidden_sky():
    """A sky that hides from the camera, but not from mirrors and glass."""
    scene = sky()
    scene["integrator"]["hide_emitters"] = True
    return scene


def bumps():
    """Materials with normals of their own, which the shape does not know: a wall, a floor and a pane of glass."""

    def bitmap(values):
        bitmap = mi.Bitmap(np.asarray(values, np.float32))
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}

    def tilted(x, y, bsdf):
        normal = np.array([x, y, np.sqrt(1 - x * x - y * y)]) / 2 + 0.5
        return {"type": "normalmap", "normalmap": bitmap(np.tile(normal, (2, 2, 1))), "bsdf": bsdf}

    heights = np.random.default_rng(2).random((8, 8, 1))
    scene = _stage(
        lamp=_light([0, 2, 0.6], [0, -1, 0], (0.6, 0.6), (15, 12, 10)),
        glass=_sphere([0.6, 0.35, 0.6], 0.3, tilted(0.2, 0.1, {"type": "dielectric"})),
    )
    scene["wall"]["bsdf"] = {"type": "twosided", "nested": tilted(0.6, 0.2, _diffuse(0.7, 0.2, 0.2))}
    rough = {"type": "bumpmap", "arbitrary": bitmap(heights), "scale": 2.0, "bsdf": _diffuse(0.6, 0.5, 0.4)}
    scene["floor"]["bsdf"] = {"type": "twosided", "nested": rough}
    return scene


def without_the_point():
    """``plenty`` but for its point light: ``path`` never sees that through the holes and the pane, light paths do."""
    scene = plenty()
    del scene["point"]
    return scene


def lit_instead(name, lamp):
    """``caustics`` with another lamp of that name."""

    def scene():
        return {part: value for part, value in caustics().items() if part != "lamp"} | {name: lamp}

    return scene


by_a_point = lit_instead("point", {"type": "point", "position": [0.2, 2.6, -0.2], "intensity": _rgb(9, 9, 9)})
by_the_sun = lit_instead("sun", {"type": "directional", "direction": [0.1, -1, 0.05], "irradiance": _rgb(9, 9, 9)})
# By a sky alone: chains end where it is.
under_a_sky = lit_instead("sky", {"type": "constant", "radiance": _rgb(1, 2, 3)})


def by_a_wall():
    """The same ball and mirror, lit by what a lamp lights: the light's end is not what stays."""
    return caustics() | {
        "lamp": _light([0.2, 1.2, -0.2], [0, 1, 0], (0.6, 0.6), (20, 20, 20)),
        "ceiling": _wall([0, 2.4, 0], [0, -1, 0], (4, 4), _diffuse(0.8, 0.6, 0.5)),
    }


def lacquered():
    """A room with a ball of glass and a lacquered one: it mirrors, but paths may be joined at it too."""
    scene = glass()
    del scene["hole"]
    scene["rough"]["bsdf"] = {"type": "plastic"}
    return scene


def seen_through_glass():
    """A floor under a pane of thick glass, lit through it by a point: no connection finds that light."""
    pane = {"type": "cube", "bsdf": {"type": "dielectric"}}
    pane["to_world"] = mi.ScalarTransform4f().translate([0, 0.3, 0]).scale([5, 0.1, 5])
    scene = {part: value for part, value in _stage().items() if part not in ("wall", "ball")}
    return scene | {"pane": pane, "point": {"type": "point", "position": [0, 2, 0], "intensity": 5.0}}


SCENES = {
    room.__name__: room for room in (points, areas, sky, glass, hidden_lamp, hidden_sky, bumps, furnace, caustics)
}
SCENES |= {"plenty": without_the_point, "polished": lambda: polished(0.05)}
SCENES |= {name: name for name in ("diffuse", "glossy", "environment", "lens")}
