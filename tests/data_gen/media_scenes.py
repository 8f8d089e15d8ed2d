"""Scenes with media for the statistical tests: small rooms seen from near by, so that pixels are wide."""

from data_gen_scenes import _scale
from renders import mi

from data_gen.scenes.builtin import _camera, _diffuse, _light, _rgb, _sphere, _wall


def room(medium, walls=(0.6, 0.6, 0.6), **more):
    """A corner with a ball and a lamp, filled with a medium in which the camera stands."""
    camera = _camera([0.2, 0.3, 2.2], [0, 0, 0], 60) | {"medium": {"type": "ref", "id": "air"}}
    return {
        "type": "scene",
        "air": {"type": "homogeneous", "id": "air"} | medium,
        "integrator": {"type": "volpath", "max_depth": 6, "rr_depth": 4},
        "sensor": camera,
        "floor": _wall([0, -1, 0], [0, 1, 0], (5, 5), _diffuse(*walls)),
        "wall": _wall([-1, 0, 0], [1, 0, 0], (5, 5), _diffuse(0.6, 0.3, 0.2)),
        "back": _wall([0, 0, -1], [0, 0, 1], (5, 5), _diffuse(0.4, 0.5, 0.6)),
        "ball": _sphere([0.3, -0.5, 0.2], 0.5, _diffuse(0.7, 0.6, 0.3)),
        "lamp": _light([0.2, 1.6, 0.6], [0, -1, 0], (1.2, 1.2), (9, 9, 9)),
        **more,
    }


def filled(medium):
    return lambda: room(medium)


# Isotropic, of one colour; with g = 0.8; with another extinction and albedo in each colour; of depth 4 across the view
haze = filled({"albedo": 0.9, "sigma_t": 0.4})
forward = filled({"albedo": 0.95, "sigma_t": 0.6, "phase": {"type": "hg", "g": 0.8}})
colours = filled({"albedo": _rgb(0.9, 0.8, 0.6), "sigma_t": _rgb(0.3, 0.6, 1.0)})
dense = filled({"albedo": 0.8, "sigma_t": 1.5})


def milk():
    """Balls of clear and of frosted glass full of a medium, in clear air, before the sky."""
    liquid = {"type": "homogeneous", "albedo": _rgb(0.95, 0.9, 0.7), "sigma_t": 1.5}
    scene = room({"sigma_t": 0.1}) | {
        "sky": {"type": "constant", "radiance": _rgb(0.4, 0.5, 0.6)},
        "clear": _sphere([-0.5, -0.2, 0.3], 0.4, {"type": "dielectric"}) | {"interior": liquid},
        "ball": _sphere([0.4, -0.3, 0.3], 0.6, {"type": "roughdielectric", "alpha": 0.3}) | {"interior": dict(liquid)},
    }
    del scene["air"], scene["sensor"]["medium"], scene["back"]
    return scene


def nested():
    """A cloud behind boundaries that bend nothing, with another one inside, a ball half in it, and mist around both."""
    mist = {"type": "ref", "id": "air"}
    cloud = {"albedo": _rgb(0.9, 0.7, 0.8), "sigma_t": _rgb(0.6, 0.4, 0.5), "scale": 2.0}
    cloud = {"type": "homogeneous", "id": "cloud", **cloud}
    core = {"type": "homogeneous", "albedo": 0.6, "sigma_t": 3.0, "phase": {"type": "hg", "g": -0.3}}
    inside = {"interior": {"type": "ref", "id": "cloud"}, "exterior": mist}
    scene = room({"albedo": 0.8, "sigma_t": 0.15})
    return {
        "type": "scene",
        "cloud": cloud,
        **scene,
        "outer": {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, **inside},
        "inner": _sphere([-0.2, 0.2, 0.1], 0.35, {"type": "null"})
        | {"interior": core, "exterior": {"type": "ref", "id": "cloud"}},
        "ball": _sphere([0.9, -0.6, 0.2], 0.15, _diffuse(0.7, 0.6, 0.3)) | {"exterior": mist, "interior": mist},
    }


def hovering():
    """A wide box of fog a little above the floor: light goes to and fro between them at grazing angles."""
    return above_the_floor(0.05)


def standing():
    """A box of fog whose lower face lies in the floor, before a sky."""
    return above_the_floor(0.0) | {"sky": {"type": "constant", "radiance": _rgb(1, 1, 1)}}


def above_the_floor(gap):
    place = mi.ScalarTransform4f().translate([0, gap - 0.6, 0]).scale([0.8, 0.4, 0.8])
    fog = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.2}
    scene = room({"sigma_t": 0.1})
    scene["box"] = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": fog}
    for name in ("air", "wall", "back", "ball", "lamp") if not gap else ("air", "ball"):
        del scene[name]
    del scene["sensor"]["medium"]
    return scene


def smoke():
    """A cloud whose density varies, in a box that is larger, between a ball, the floor and a lamp."""
    return cloudy(grid(1))


def wisps():
    """Grids that fade out within their box, in mist: other densities in each colour, and an albedo that varies."""
    volumes = {"sigma_t": density(3, 0.2, 1.0, 3, fades=True), "albedo": density(3, 0.5, 1.0, 7)}
    cloud = {name: {"type": "gridvolume", "grid": grid, **placed()} for name, grid in volumes.items()}
    return cloudy({"type": "heterogeneous", "scale": 6.0} | cloud, mist={"albedo": 0.8, "sigma_t": 0.1})


def coloured_smoke():
    """The same with another density in each colour, an albedo that varies, and mist around it."""
    cloud = grid(3) | {"albedo": {"type": "gridvolume", "grid": density(3, 0.5, 1.0, 7), **placed()}}
    return cloudy(cloud, mist={"albedo": 0.8, "sigma_t": 0.1})


def before_the_sky():
    """The same in the open: before a sky, and before a lamp in plain view, half of it behind the cloud."""
    scene = glowing(smoke()) | {"sky": {"type": "constant", "radiance": _rgb(0.4, 0.5, 0.6)}}
    del scene["integrator"]["hide_emitters"], scene["back"], scene["wall"]
    return scene


def seen_through():
    """The same by paths of one edge: before anything scatters."""
    return before_the_sky() | {"integrator": {"type": "volpath", "max_depth": 1}}


def hiding():
    """A lamp in plain view, half behind a cloud, that hides from the camera; and mist around the camera."""
    return glowing(cloudy(grid(1), mist={"albedo": 0.8, "sigma_t": 0.2}))


def hiding_outside():
    """The same in clear air."""
    return glowing(smoke())


def glowing(scene):
    glow = _sphere([0.75, 0.1, 0.3], 0.25, _diffuse(0.2, 0.2, 0.2)) | {
        "emitter": {"type": "area", "radiance": _rgb(3, 2, 1)}
    }
    return scene | {"glow": glow, "integrator": scene["integrator"] | {"hide_emitters": True}}


def by_mis(scene):
    """The same rendered by ``volpathmis``, which weights the colours against each other."""

    def described():
        description = scene()
        return description | {"integrator": description["integrator"] | {"type": "volpathmis"}}

    described.__name__ = f"{scene.__name__}_by_mis"
    return described


def cloudy(cloud, mist=None):
    around = {"exterior": {"type": "ref", "id": "air"}} if mist else {}
    scene = room(mist or {"sigma_t": 0.1})
    if not mist:
        del scene["air"], scene["sensor"]["medium"]
    scene["ball"] = _sphere([0.0, -0.85, 1.05], 0.15, _diffuse(0.7, 0.6, 0.3))
    box = mi.ScalarTransform4f().translate([0.0, 0.0, 0.1]).scale(0.8)
    scene["box"] = {"type": "cube", "to_world": box, "bsdf": {"type": "null"}, "interior": cloud, **around}
    return scene


def grid(channels):
    volume = {"type": "gridvolume", "grid": density(channels, 0.0, 1.0, 5), **placed()}
    return {"type": "heterogeneous", "albedo": 0.9, "sigma_t": volume, "scale": 4.0}


def placed():
    """Where grids are: smaller than their box."""
    return {"to_world": mi.ScalarTransform4f().translate([-0.7, -0.7, -0.6]).scale(1.4)}


def density(channels, low, high, seed, fades=False):
    """Random values from ``low`` to ``high``; where it ``fades``, 0 along its edges."""
    import numpy as np

    values = np.random.default_rng(seed).uniform(low, high, (5, 5, 5, channels)).astype(np.float32)
    if fades:
        values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 0
    return mi.VolumeGrid(values)
