"""Rooms in which light could leak through what is thinner than a cell of the cache, each a dictionary for Mitsuba."""

import mitsuba as mi
import numpy as np

from data_gen.scenes.builtin import _box, _camera, _diffuse, _light, _rgb, _room, _sphere, _wall

OPEN = {"origin": [0, 1.25, 3.9], "target": [0, 1.1, 0], "fov": 50}


def _grey(value=0.6):
    return {"type": "twosided", "nested": _diffuse(value, value, value)}


def _place(origin, target, fov=60, **things):
    """A scene of ``things`` seen from there."""
    integrator = {"type": "path", "max_depth": 8, "rr_depth": 5}
    return {"type": "scene", "integrator": integrator, "sensor": _camera(list(origin), list(target), fov), **things}


def _walls(x, height, back, front, grey=0.6):
    """Six walls of a closed room from -x to x and from ``back`` to ``front``, seen from inside."""
    y, z, deep, bsdf = height / 2, (back + front) / 2, front - back, _grey(grey)
    return {
        "floor": _wall([0, 0, z], [0, 1, 0], (2 * x, deep), bsdf),
        "ceiling": _wall([0, height, z], [0, -1, 0], (2 * x, deep), bsdf),
        "left": _wall([-x, y, z], [1, 0, 0], (deep, height), bsdf),
        "right": _wall([x, y, z], [-1, 0, 0], (deep, height), bsdf),
        "back": _wall([0, y, back], [0, 0, 1], (2 * x, height), bsdf),
        "front": _wall([0, y, front], [0, 0, -1], (2 * x, height), bsdf),
    }


def shelf():
    """A board of 5 mm on a wall, bright above and dark below."""
    return _place(
        (0, 1.0, 1.4),
        (0, 1.0, -1.5),
        **_walls(1.5, 2.4, -1.5, 1.5),
        lamp=_light([0, 2.39, -0.9], [0, -1, 0], (0.8, 0.5), (10, 9, 8)),
        board=_box([0, 1.1, -1.25], [2.0, 0.005, 0.5], 0, _grey()),
        below=_box([0, 0.6, -1.25], [2.0, 0.005, 0.5], 0, _grey()),
    )


def thin_wall():
    """A sheet without thickness between a bright room and one with a hundredth of its light; both are seen."""
    scene = _place(
        (0, 1.2, 3.6),
        (0, 1.2, 0),
        **_walls(1.5, 2.4, -1.5, 1.5, 0.5),
        middle=_wall([0, 1.2, 0], [1, 0, 0], (3, 2.4), _grey(0.5)),
        lamp=_light([-0.8, 2.39, -0.3], [0, -1, 0], (0.6, 0.6), (20, 18, 16)),
        night=_light([0.8, 2.39, -0.3], [0, -1, 0], (0.6, 0.6), (0.16, 0.18, 0.2)),
    )
    del scene["front"]
    return scene


def door():
    """A dark room with light from the next one under a door, and little of its own."""
    return _place(
        (0.3, 0.9, 1.3),
        (0, 0.4, -0.4),
        **_walls(1.2, 2.2, -2, 1.5),
        door=_box([0, 1.14, -0.5], [2.4, 2.2, 0.04], 0, _grey()),
        lamp=_light([0, 0.5, -1.99], [0, 0, 1], (2.2, 0.9), (30, 27, 24)),
        night=_light([0, 2.19, 0.5], [0, -1, 0], (0.5, 0.5), (0.08, 0.09, 0.1)),
    )


def shade():
    """A lamp inside a tube that is open above and below."""
    bulb = _sphere([0, 1.0, 0], 0.06, _diffuse(0, 0, 0))
    tube = {"type": "cylinder", "p0": [0, 0.8, 0], "p1": [0, 1.2, 0], "radius": 0.22}
    return _place(
        (0, 1.1, 1.6),
        (0, 0.9, 0),
        **_walls(1.2, 2.2, -1.2, 1.7),
        bulb=bulb | {"emitter": {"type": "area", "radiance": _rgb(60, 50, 40)}},
        tube=tube | {"to_world": mi.ScalarTransform4f(), "bsdf": _grey(0.7)},
    )


def contact():
    """A box 5 mm above the floor, and a ball that touches it."""
    return _place(
        (0, 0.7, 1.2),
        (0, 0.15, -0.2),
        fov=50,
        **_walls(1.2, 2.2, -1.2, 1.3),
        lamp=_light([0.3, 2.19, 0.2], [0, -1, 0], (1.2, 1.2), (4, 4, 4)),
        box=_box([-0.3, 0.205, -0.2], [0.4, 0.4, 0.4], 20, _grey()),
        ball=_sphere([0.35, 0.2, 0], 0.2, _grey()),
    )


def slit():
    """A bright lamp behind a slit in its case: a stripe of light on the wall, which few paths find."""
    return _place(
        (0, 1.1, 1.6),
        (0, 1.0, -1.2),
        **_walls(1.2, 2.2, -1.2, 1.7),
        lamp=_light([0.7, 2.15, 0.5], [0, -1, 0], (0.2, 0.6), (400, 380, 350)),
        near=_box([0.44, 1.99, 0.5], [0.48, 0.02, 1.0], 0, _grey()),
        far=_box([0.96, 1.99, 0.5], [0.48, 0.02, 1.0], 0, _grey()),
        night=_light([-0.6, 2.19, 0.2], [0, -1, 0], (0.3, 0.3), (1, 1, 1)),
    )


def foggy(scene, sigma_t=0.4):
    """The scene filled with fog that scatters evenly."""
    fog = {"type": "homogeneous", "id": "fog", "albedo": 0.95, "sigma_t": sigma_t}
    inside = {"medium": {"type": "ref", "id": "fog"}}
    integrator = scene["integrator"] | {"type": "volpath"}
    return {"type": "scene", "fog": fog} | scene | {"integrator": integrator, "sensor": scene["sensor"] | inside}


def foggy_sheet():
    """The sheet without thickness between bright fog and dark fog."""
    return foggy(thin_wall())


def half_fog():
    """The same room with fog in its left half, behind a boundary that bends nothing, and clear air in the right one."""
    scene = door()
    fog = {"type": "homogeneous", "albedo": 0.95, "sigma_t": 1.0}
    block = {"type": "cube", "bsdf": {"type": "null"}, "interior": fog}
    block["to_world"] = mi.ScalarTransform4f().translate([-0.75, 1.2, 0]).scale([0.7, 1.1, 1.4])
    return scene | {"integrator": scene["integrator"] | {"type": "volpath"}, "block": block}


def bulb():
    """A room whose only lamp is inside a ball of glass: all of its light comes over rough surfaces and then glass."""
    lamp = _sphere([0, 1.2, 0], 0.5, _diffuse(0, 0, 0)) | {"emitter": {"type": "area", "radiance": 3.0}}
    glass = _sphere([0, 1.2, 0], 0.6, {"type": "dielectric"})
    return _place(**OPEN, **_room(1.5, _diffuse(0.6, 0.6, 0.6)), lamp=lamp, glass=glass)


def mirrors():
    """A room with a mirror on the wall, and a small ball that mirrors before it."""
    mirror = {"type": "twosided", "nested": {"type": "conductor", "material": "none"}}
    return _place(
        **OPEN,
        **_room(1.5, _diffuse(0.7, 0.6, 0.5)),
        lamp=_light([0, 2.3, 0], [0, -1, 0], (1.6, 1.6), (3, 3, 3)),
        pane=_wall([-1.4, 1.2, 0], [1, 0, 0], (1.8, 1.6), mirror),
        ball=_sphere([0.6, 0.35, 0.3], 0.35, mirror),
    )


def varnish():
    """A room whose floor is dark varnish, which sends the light of a window in one wall to the wall across."""
    wood = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": 0.02}}
    return _place(
        (0, 1.2, 1.4),
        (0, 0.9, -1.5),
        fov=90,
        **_walls(1.5, 2.4, -1.5, 1.5, 0.3) | {"floor": _wall([0, 0, 0], [0, 1, 0], (3, 3), wood)},
        window=_light([-1.49, 0.6, 0], [1, 0, 0], (1.5, 0.8), (6, 7, 8)),
    )


def two_rooms(thick, place, unit, far):
    """A bright room and one with a seventieth of its light, and a wall so ``thick`` between them, at x = ``place``.

    Lengths are in metres; the scene has them in ``unit`` times that, and is moved by ``far`` metres.
    """
    scene = _place(
        (place, 1.3, 3.4),
        (place, 1.1, 0),
        fov=75,
        **_walls(2.2, 2.4, -2, 2),
        lamp=_light([place - 1.1, 2.39, -0.3], [0, -1, 0], (0.6, 0.6), (20, 18, 16)),
        night=_light([place + 1.1, 2.39, -0.3], [0, -1, 0], (0.6, 0.6), (0.27, 0.27, 0.27)),
        box=_box([place - 1.2, 0.3, -0.8], [0.6, 0.6, 0.6], 0, _grey(0.5)),
        other=_box([place + 1.2, 0.3, -0.8], [0.6, 0.6, 0.6], 0, _grey(0.5)),
    )
    del scene["front"]
    wall = _box([place, 1.2, 0], [thick, 2.4, 4], 0, _grey()) if thick else None
    scene["middle"] = wall or _wall([place, 1.2, 0], [1, 0, 0], (4, 2.4), _grey())
    move = mi.ScalarTransform4f().scale([unit] * 3) @ mi.ScalarTransform4f().translate([far] * 3)
    for part in scene.values():
        if isinstance(part, dict) and "to_world" in part and part["type"] != "perspective":
            part["to_world"] = move @ part["to_world"]
    origin, target = (list(unit * (np.array(p) + far)) for p in ((place, 1.3, 3.4), (place, 1.1, 0)))
    scene["sensor"] = _camera(origin, target, 75) | {"near_clip": 1e-2 * unit, "far_clip": 1e3 * unit}
    return scene


def of_material(material):
    """A room with a lamp, whose floor, back and box are made of a ``material``."""
    scene = _place(
        (0, 1.2, 1.4),
        (0, 0.9, -1.5),
        fov=80,
        **_walls(1.5, 2.4, -1.5, 1.5),
        lamp=_light([0.5, 2.39, 0.2], [0, -1, 0], (0.8, 0.6), (9, 8, 7)),
        box=_box([-0.6, 0.3, -0.7], [0.6, 0.6, 0.6], 30, material),
    )
    for part in ("floor", "back"):
        scene[part]["bsdf"] = material
    return scene
