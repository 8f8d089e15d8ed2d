"""The built-in scenes: small, made in code, one for each kind of light transport that the demo shows.

Each function returns a Mitsuba scene dictionary. Units are metres, and +y is up.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable

import mitsuba as mi
import numpy as np

from data_gen.scenes import grids
from ngpt.errors import NgptError, did_you_mean


def _transform():
    return mi.ScalarTransform4f()


def _rgb(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


def _diffuse(*value: float) -> dict:
    return {"type": "diffuse", "reflectance": _rgb(*value)}


def _camera(origin, target, fov: float, **extra) -> dict:
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "larger",
        "to_world": _transform().look_at(origin=origin, target=target, up=[0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": 640,
            "height": 360,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    } | extra


def _wall(center, normal, size: tuple[float, float], bsdf: dict) -> dict:
    """A rectangle of ``size`` metres whose front faces along ``normal``."""
    up = [0, 0, 1] if abs(normal[1]) > 0.5 else [0, 1, 0]
    target = [c + n for c, n in zip(center, normal, strict=True)]
    to_world = _transform().look_at(origin=center, target=target, up=up).scale([size[0] / 2, size[1] / 2, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def _box(center, size, angle: float, bsdf: dict) -> dict:
    to_world = _transform().translate(center).rotate([0, 1, 0], angle).scale([s / 2 for s in size])
    return {"type": "cube", "to_world": to_world, "bsdf": bsdf}


def _sphere(center, radius: float, bsdf: dict) -> dict:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _light(center, normal, size: tuple[float, float], radiance: tuple[float, float, float]) -> dict:
    light = _wall(center, normal, size, _diffuse(0, 0, 0))
    return light | {"emitter": {"type": "area", "radiance": _rgb(*radiance)}}


def _room(front: float, floor: dict) -> dict:
    """Walls of a room 3 m wide and 2.4 m high, from z = -1.5 m to ``front``; the side toward +z is left open."""
    width, height, depth = 3, 2.4, front + 1.5
    middle = (front - 1.5) / 2
    white = _diffuse(0.75, 0.73, 0.7)
    return {
        "floor": _wall([0, 0, middle], [0, 1, 0], (width, depth), floor),
        "ceiling": _wall([0, height, middle], [0, -1, 0], (width, depth), white),
        "back": _wall([0, height / 2, -1.5], [0, 0, 1], (width, height), white),
        "left": _wall([-width / 2, height / 2, middle], [1, 0, 0], (depth, height), _diffuse(0.62, 0.2, 0.13)),
        "right": _wall([width / 2, height / 2, middle], [-1, 0, 0], (depth, height), _diffuse(0.14, 0.34, 0.42)),
    }


def _path(max_depth: int) -> dict:
    return {"type": "path", "max_depth": max_depth, "rr_depth": 5}


def diffuse() -> dict:
    """A room of matte surfaces under one lamp: soft shadows and colour bleeding."""
    tiles = {"type": "checkerboard", "color0": _rgb(0.3, 0.28, 0.25), "color1": _rgb(0.7, 0.68, 0.62)}
    tiles["to_uv"] = _transform().scale([4, 4, 1])
    return {
        "type": "scene",
        "integrator": _path(8),
        "sensor": _camera([0, 1.25, 3.9], [0, 1.15, 0], 50),
        **_room(1.5, {"type": "diffuse", "reflectance": tiles}),
        "lamp": _light([0, 2.2, -0.2], [0, -1, 0], (0.8, 0.6), (14, 12, 9)),
        "tall": _box([-0.55, 0.65, -0.5], [0.7, 1.3, 0.6], 20, _diffuse(0.7, 0.68, 0.64)),
        "low": _box([0.6, 0.3, 0.25], [0.6, 0.6, 0.6], -18, _diffuse(0.65, 0.55, 0.25)),
        "ball": _sphere([0.6, 0.85, 0.25], 0.25, _diffuse(0.3, 0.42, 0.6)),
    }


def glossy() -> dict:
    """A room with brushed metal, lacquer, a mirror and a glass ball: reflections and a caustic."""
    return {
        "type": "scene",
        "integrator": _path(12),
        "sensor": _camera([0, 1.25, 3.9], [0, 1.05, 0], 50),
        **_room(4.5, {"type": "roughplastic", "diffuse_reflectance": _rgb(0.35, 0.3, 0.24), "alpha": 0.15}),
        "front": _wall([0, 1.2, 4.5], [0, 0, -1], (3, 2.4), _diffuse(0.6, 0.58, 0.5)),
        "lamp": _light([0, 2.25, 0.2], [0, -1, 0], (1.2, 1.0), (7, 6.6, 6)),
        "metal": _box(
            [-0.6, 0.6, -0.5], [0.7, 1.2, 0.6], 25, {"type": "roughconductor", "material": "Al", "alpha": 0.12}
        ),
        "glass": _sphere([0.35, 0.42, 0.55], 0.42, {"type": "dielectric", "int_ior": 1.5}),
        "gold": _sphere([0.85, 0.35, -0.5], 0.35, {"type": "roughconductor", "material": "Au", "alpha": 0.25}),
        "lacquer": _sphere(
            [-0.45, 0.22, 0.75], 0.22, {"type": "plastic", "diffuse_reflectance": _rgb(0.55, 0.06, 0.05)}
        ),
        "mirror": _wall([0.35, 1.35, -1.48], [0, 0, 1], (1.1, 0.9), {"type": "conductor", "material": "Ag"}),
    }


def environment() -> dict:
    """Objects on a table in the open, lit by a sky with a low sun: hard and soft light, and a background."""
    return {
        "type": "scene",
        "integrator": _path(8),
        "sensor": _camera([0.3, 1.5, 4.2], [0, 0.55, 0], 38),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(_sky(64, 128)), "scale": 1.0},
        "ground": _wall([0, 0, 0], [0, 1, 0], (120, 120), _diffuse(0.42, 0.38, 0.33)),
        "ball": _sphere([-0.75, 0.6, 0], 0.6, {"type": "plastic", "diffuse_reflectance": _rgb(0.1, 0.27, 0.42)}),
        "block": _box([0.75, 0.45, -0.35], [0.8, 0.9, 0.8], 33, _diffuse(0.6, 0.5, 0.4)),
        "copper": _sphere([0.3, 0.28, 0.8], 0.28, {"type": "roughconductor", "material": "Cu", "alpha": 0.2}),
    }


def lens() -> dict:
    """A row of balls seen through a wide lens: sharp in the middle, blurred before and behind."""
    colors = [(0.6, 0.2, 0.15), (0.6, 0.45, 0.15), (0.25, 0.5, 0.25), (0.15, 0.35, 0.55), (0.45, 0.25, 0.5)]
    balls = {
        f"ball{i}": _sphere([-1.0 + 0.5 * i, 0.3, 1.2 - 0.8 * i], 0.3, _diffuse(*color))
        for i, color in enumerate(colors)
    }
    lens = {"type": "thinlens", "aperture_radius": 0.07, "focus_distance": 4.0}
    return {
        "type": "scene",
        "integrator": _path(6),
        "sensor": _camera([0, 1.0, 3.6], [0, 0.35, -0.4], 40) | lens,
        "floor": _wall([0, 0, 0], [0, 1, 0], (8, 8), _diffuse(0.5, 0.48, 0.45)),
        "back": _wall([0, 2, -3.2], [0, 0, 1], (8, 4), _diffuse(0.45, 0.5, 0.55)),
        "lamp": _light([1.2, 3.5, 2.5], [-0.3, -1, -0.5], (1.5, 1.5), (11, 10, 9)),
        "dots": _sphere([1.3, 1.4, -2.6], 0.06, _diffuse(0, 0, 0))
        | {"emitter": {"type": "area", "radiance": _rgb(30, 20, 8)}},
        **balls,
    }


def _volume(box: tuple, medium: dict) -> dict:
    """A box from the corner ``box[0]`` to the corner ``box[1]``. Only the medium in it is visible."""
    low, high = np.array(box, float)
    to_world = _transform().translate(list((low + high) / 2)).scale(list((high - low) / 2))
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def _grid_medium(grid: np.ndarray, box: tuple, sigma_t: float, albedo: dict, g: float) -> dict:
    """A medium whose extinction is ``grid`` times ``sigma_t``, per metre, within ``box``."""
    low, high = np.array(box, float)
    to_world = _transform().translate(list(low)).scale(list(high - low))
    return {
        "type": "heterogeneous",
        "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(grid[..., None]), "to_world": to_world, "raw": True},
        "albedo": {"type": "constvolume", "value": albedo},
        "scale": sigma_t,
        "phase": {"type": "hg", "g": g},
    }


def haze() -> dict:
    """A spot from outside shines through a barred window into haze: beams, and shadows in the air around the camera."""
    tiles = {"type": "checkerboard", "color0": _rgb(0.16, 0.15, 0.14), "color1": _rgb(0.45, 0.43, 0.4)}
    tiles["to_uv"] = _transform().scale([4, 8, 1])
    air = {"type": "homogeneous", "albedo": _rgb(0.95, 0.95, 0.95), "sigma_t": 0.2, "phase": {"type": "hg", "g": 0.3}}
    camera = _camera([0, 1.15, 4.2], [0, 1.1, 0], 50)
    scene = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 12, "rr_depth": 5},
        "air": air | {"id": "air"},
        "sensor": camera | {"medium": {"type": "ref", "id": "air"}},
        **_room(4.5, {"type": "diffuse", "reflectance": tiles}),
        "front": _wall([0, 1.2, 4.5], [0, 0, -1], (3, 2.4), _diffuse(0.5, 0.48, 0.45)),
        "lamp": _light([0.3, 2.38, 1.5], [0, -1, 0], (1.2, 1.2), (1.5, 1.7, 2.0)),
        "spot": {
            "type": "spot",
            "to_world": _transform().look_at(origin=[-3.3, 3.2, -0.7], target=[0.45, 0.5, 0.15], up=[0, 1, 0]),
            "intensity": _rgb(170, 135, 95),
            "cutoff_angle": 16,
            "beam_width": 15,
        },
        "ball": _sphere([0.45, 0.75, 0.1], 0.28, {"type": "roughconductor", "material": "Cu", "alpha": 0.3}),
        "stand": _box([0.45, 0.24, 0.1], [0.4, 0.48, 0.4], 12, _diffuse(0.6, 0.58, 0.55)),
        "block": _box([-0.75, 0.4, 0.6], [0.5, 0.8, 0.5], 25, _diffuse(0.65, 0.55, 0.25)),
    }
    # The wall around a window that spans z from -0.9 m to 0.15 m, and y from 1.5 m to 2.2 m.
    red = _diffuse(0.62, 0.2, 0.13)
    del scene["left"]
    for name, (low, high, front, back) in {
        "under": (0, 1.5, 4.5, -1.5),
        "over": (2.2, 2.4, 4.5, -1.5),
        "behind": (1.5, 2.2, -0.9, -1.5),
        "before": (1.5, 2.2, 4.5, 0.15),
        "bar0": (1.5, 2.2, -0.48, -0.57),
        "bar1": (1.5, 2.2, -0.18, -0.27),
    }.items():
        center = [-1.5, (low + high) / 2, (front + back) / 2]
        scene[f"left_{name}"] = _wall(center, [1, 0, 0], (front - back, high - low), red)
    return scene


def smoke() -> dict:
    """Smoke that rises from a bowl in front of coloured walls, with thin and dense parts, and shadows within it."""
    box = ([-0.6, 0.42, -0.6], [0.6, 2.2, 0.6])
    grid = grids.plume(np.random.default_rng(0))
    albedo = _rgb(0.75, 0.8, 0.86)
    tiles = {"type": "checkerboard", "color0": _rgb(0.3, 0.28, 0.25), "color1": _rgb(0.7, 0.68, 0.62)}
    tiles["to_uv"] = _transform().scale([4, 4, 1])
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 8, "rr_depth": 4},
        "sensor": _camera([0, 1.25, 3.9], [0, 1.15, 0], 50),
        **_room(1.5, {"type": "diffuse", "reflectance": tiles}),
        "lamp": _light([0.9, 2.2, -0.5], [-0.3, -1, 0], (0.7, 0.7), (18, 15, 11)),
        "bowl": _box([0, 0.2, 0], [0.5, 0.4, 0.5], 30, {"type": "roughconductor", "material": "Cu", "alpha": 0.2}),
        "ball": _sphere([-0.85, 0.3, 0.4], 0.3, _diffuse(0.3, 0.42, 0.6)),
        "low": _box([0.8, 0.25, 0.45], [0.5, 0.5, 0.5], -18, _diffuse(0.65, 0.55, 0.25)),
        "smoke": _volume(box, _grid_medium(grid, box, 4, albedo, 0.2)),
    }


def cloud() -> dict:
    """A small cloud over a ball and a block in the open: light that scatters many times, in front of a plain sky."""
    box = ([-1.3, 1.2, -0.8], [1.3, 2.7, 0.8])
    grid = grids.cloud(np.random.default_rng(2))
    scene = environment()
    del scene["copper"]
    return scene | {
        "integrator": {"type": "volpath", "max_depth": 24, "rr_depth": 8},
        "sensor": _camera([0.3, 0.5, 5.4], [0, 1.25, 0], 42),
        "cloud": _volume(box, _grid_medium(grid, box, 9, _rgb(0.99, 0.99, 0.99), 0.5)),
    }


def _sky(height: int, width: int) -> np.ndarray:
    """A latitude-longitude sky, (height, width, 3) float32: blue gradient, dim ground, and a sun of a few texels."""
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    up = np.clip(np.sin(elevation), 0, 1)[:, None]
    image = np.empty((height, width, 3), np.float32)
    image[:] = ((1 - up) * [0.9, 0.85, 0.8] + up * [0.2, 0.38, 0.75])[:, None, :]
    image[elevation < 0] = [0.12, 0.1, 0.08]
    row, column = int(height * 0.3), int(width * 0.62)
    image[row : row + 3, column : column + 3] = [160, 135, 95]
    return image


SURFACES = {"diffuse": diffuse, "glossy": glossy, "environment": environment, "lens": lens}
MEDIA = {"haze": haze, "smoke": smoke, "cloud": cloud}
SCENES = SURFACES | MEDIA


def no_scene(name: str, others: Iterable[str] = ()) -> NgptError:
    """The error for a name that is neither a file nor a built-in scene. ``others`` may have been meant, too."""
    if os.path.isdir(name):
        files = sorted(glob.glob(os.path.join(glob.escape(name), "*.xml")))
        such = f", such as {files[0]}" if files else ""
        return NgptError(f"{name}: is a folder; name a scene file{such}")
    meant = did_you_mean(name, [*SCENES, *others])
    return NgptError(f"{name}: no such file, nor a built-in scene; {meant}those are: {', '.join(SCENES)}")
