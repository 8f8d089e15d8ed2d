"""Lamps of all kinds that light can be traced from, over a floor before a wall."""

import tempfile

import numpy as np
from renders import mi

from data_gen.scenes.builtin import _camera, _diffuse, _light, _rgb, _sphere, _wall


def lamps() -> dict:
    """Of each kind one: areas (a textured rectangle, a coarse mesh with smooth normals), points, and what is far."""
    rng, toward = np.random.default_rng(5), mi.ScalarTransform4f().look_at
    texels = {"type": "bitmap", "bitmap": mi.Bitmap((rng.random((3, 5, 3)) ** 3 * 30).astype(np.float32)), "raw": True}
    slide = {"type": "bitmap", "bitmap": mi.Bitmap(rng.random((4, 4, 3)).astype(np.float32)), "raw": True}
    picture = {"type": "area", "radiance": texels, "sampling_weight": 2.5}
    return {
        "picture": _light([0.7, 1.8, 0.3], [0, -1, 0], (0.8, 0.5), (1, 1, 1)) | {"emitter": picture},
        "glow": bowl([0.7, 0.45, 0.5], 0.25) | {"emitter": {"type": "area", "radiance": _rgb(4, 5, 2)}},
        "point": {"type": "point", "position": [-0.8, 1.6, 1], "intensity": _rgb(1.5, 2, 2.5)},
        "spot": {
            "type": "spot",
            "to_world": toward([1, 1.8, 1.2], [0, 0.2, 0], [0, 1, 0]),
            "intensity": _rgb(12, 9, 7),
            "cutoff_angle": 25,
            "beam_width": 8,
            "texture": slide,
        },
        "sun": {"type": "directional", "direction": [0.4, -1, -0.6], "irradiance": _rgb(1, 0.8, 0.5)},
        "sky": {"type": "constant", "radiance": _rgb(0.2, 0.25, 0.4), "sampling_weight": 0.5},
    }


def lit_by(fog: bool = False) -> dict:
    """A floor, a lacquered wall and a ball lit by all ``lamps``; in a box of fog, or not.

    Lamps hide from the camera: their edges would be noisier than all that is gathered.
    """
    lacquer = {"type": "roughplastic", "alpha": 0.3, "nonlinear": True, "diffuse_reflectance": _rgb(0.3, 0.5, 0.7)}
    lit = {
        "type": "scene",
        "integrator": {"type": "volpath" if fog else "path", "max_depth": 4, "rr_depth": 2, "hide_emitters": True},
        "sensor": _camera([0.3, 1.2, 4], [0, 0.7, 0], 36),
        "floor": _wall([0, 0, 0], [0, 1, 0], (2.6, 2.6), _diffuse(0.6, 0.5, 0.4)),
        "wall": _wall([0, 1, -1], [0.2, 0, 1], (2.6, 2), {"type": "twosided", "nested": lacquer}),
        "ball": _sphere([-0.5, 0.5, 0.2], 0.45, _diffuse(0.5, 0.6, 0.3)),
    }
    lit |= lamps()
    if fog:
        air = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3}
        place = mi.ScalarTransform4f().translate([0, 1, 0.3]).scale([1.6, 0.95, 1.2])
        lit["box"] = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": air}
    return lit


def bowl(centre, radius: float, rows: int = 6) -> dict:
    """A sphere of few faces, which meet at up to 60 degrees, with the normals of a sphere at its vertices."""
    θ, φ = np.linspace(0.02, np.pi - 0.02, rows)[:, None], np.linspace(0, 2 * np.pi, rows + 1)[None, :-1]
    normals = np.stack(np.broadcast_arrays(np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)), -1).reshape(-1, 3)
    faces = []
    for i in range(rows - 1):
        for j in range(rows):
            a, b = i * rows + j, i * rows + (j + 1) % rows
            faces += [[a, b, a + rows], [b, b + rows, a + rows]]
    mesh = mi.Mesh("glow", len(normals), len(faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ravel(np.array(centre) + radius * normals).astype(np.float32)
    params["vertex_normals"] = np.ravel(normals).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    # Mitsuba takes no mesh with normals and emitters from memory.
    path = f"{tempfile.mkdtemp()}/mesh.ply"
    mesh.write_ply(path)
    return {"type": "ply", "filename": path, "bsdf": _diffuse(0.5, 0.2, 0.1)}


def gallery(flat=True, sky=True, fog=False, low=False):
    """Fourteen lamps over a floor, a wall and a mirror; not all ``flat`` ones, beside a ``sky``, in ``fog``.

    Lamps that hang ``low`` light up little of the floor each.
    """
    place = mi.ScalarTransform4f
    rng, parts = np.random.default_rng(4), {}
    for number in range(14):
        x, z = -1.6 + 0.8 * (number % 5), -1.5 + 1.2 * (number // 5)
        radiance = {"type": "rgb", "value": (10 ** rng.uniform(0.2, 1.3) * rng.uniform(0.3, 1, 3)).tolist()}
        if flat or number % 3:
            at = place().translate([x, 0.3 if low else rng.uniform(1.2, 1.8), z]).rotate([1, 0, 0], 90).scale(0.12)
            parts[f"lamp_{number}"] = {"type": "rectangle", "to_world": at, "emitter": {"type": "area"}}
            parts[f"lamp_{number}"]["emitter"]["radiance"] = radiance
        elif number % 2:
            ball = _sphere([x, 1.5, z], 0.12, _diffuse(0.5, 0.5, 0.5))
            parts[f"lamp_{number}"] = ball | {"emitter": {"type": "area", "radiance": radiance}}
        else:
            parts[f"lamp_{number}"] = {"type": "point", "position": [x, 1.5, z], "intensity": 0.1}
    if sky:
        parts["sky"] = {"type": "constant", "radiance": 0.2}
    wall = place().translate([0.2, 0.6, 0]).rotate([0, 1, 0], 90).scale([1.5, 0.6, 1])
    both = {"type": "twosided", "nested": _diffuse(0.6, 0.5, 0.4)}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sensor": _camera([0, 1.4, 4.5], [0, 0.6, 0], 50),
        "floor": {"type": "rectangle", "to_world": place().rotate([1, 0, 0], -90).scale(2.5), "bsdf": both},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": both},
        "mirror": _sphere([-1, 0.4, 0.3], 0.4, {"type": "conductor"}),
        "shiny": _sphere([1.1, 0.4, 0.5], 0.4, {"type": "roughconductor", "alpha": 0.2}),
        **parts,
    }
    if fog:
        scene["integrator"] = {"type": "volpath", "max_depth": 5}
        around = {"type": "homogeneous", "albedo": 0.7, "sigma_t": 0.2}
        box = place().translate([0, 1, 0]).scale([2.8, 1.3, 2.8])
        scene["box"] = {"type": "cube", "to_world": box, "bsdf": {"type": "null"}, "interior": around}
    return scene


GALLERIES = {
    "flat": gallery,
    "balls and points": lambda: gallery(flat=False, sky=False),
    "fog": lambda: gallery(fog=True),
}
