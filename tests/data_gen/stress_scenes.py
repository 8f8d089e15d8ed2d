"""Eight scenes of what users have and nobody tuned anything to: materials, shapes and lamps in odd company.

Every one has a camera from near by and light that Mitsuba's own integrator finds within a few hundred samples. Where
there are lamps without area, nothing is of clear glass or a mirror: ``path`` cannot see their caustics.
"""

import functools
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from data_gen.scenes.builtin import _box, _camera, _diffuse, _light, _rgb, _sphere, _transform, _wall


def bitmap(height, width, seed, low=0.0, high=1.0, channels=3):
    """Random texels, without interpolation between them."""
    texels = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}


def smooth(texture, scale=1.0):
    return texture | {"filter_type": "bilinear", "to_uv": _transform().scale([scale, scale, 1])}


def two(bsdf):
    return {"type": "twosided", "nested": bsdf}


def stage(depth=8, origin=(0.2, 1.1, 3.2), target=(0, 0.5, 0), fov=50, **things):
    """A floor, a wall at the back and a lamp above, which ``things`` may replace."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": 4},
        "sensor": _camera(list(origin), list(target), fov),
        "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), two(_diffuse(0.6, 0.5, 0.4))),
        "back": _wall([0, 1.5, -1.5], [0, 0, 1], (6, 3), two(_diffuse(0.4, 0.5, 0.6))),
        "lamp": _light([0.2, 2.4, 0.6], [0, -1, 0], (1.6, 1.6), (6, 5.5, 5)),
        "sky": {"type": "constant", "radiance": _rgb(0.3, 0.35, 0.45)},
        **things,
    }


@functools.cache
def written(name, text):
    """A file with that text, in a folder of this process; the same one if it is asked for again."""
    path = Path(tempfile.mkdtemp(prefix="ngpt-stress-")) / name
    path.write_text(text)
    return str(path)


def coarse_ball(center, radius, rings, bsdf, **more):
    """A sphere of few triangles with the normals of a sphere: the two differ by up to 30 degrees."""
    θ, φ = np.meshgrid(np.linspace(0.05, np.pi - 0.05, rings), np.linspace(0, 2 * np.pi, rings + 1)[:-1], indexing="ij")
    n = np.stack([np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)], axis=-1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rings - 1), np.arange(rings), indexing="ij"))
    a, b = i * rings + j, i * rings + (j + 1) % rings
    faces = np.concatenate([np.stack([a, b, a + rings], 1), np.stack([b, b + rings, a + rings], 1)])
    head = f"ply\nformat ascii 1.0\nelement vertex {len(n)}\n"
    head += "".join(f"property float {axis}\n" for axis in ("x", "y", "z", "nx", "ny", "nz"))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    vertices = "".join("{:.6f} {:.6f} {:.6f} {:.6f} {:.6f} {:.6f}\n".format(*v) for v in np.hstack([n, n]))
    text = head + vertices + "".join("3 {} {} {}\n".format(*f) for f in faces)
    to_world = _transform().translate(list(center)).scale(radius)
    return {"type": "ply", "filename": written("ball.ply", text), "to_world": to_world, "bsdf": bsdf, **more}


def panes():
    """Thin, rough and clear dielectrics, and a clear ball of air in a ball of glass."""
    water = {"type": "dielectric", "int_ior": 1.33}
    bubble = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.33}
    return stage(
        10,
        pane=_wall([-0.9, 0.6, 0.5], [0.3, 0, 1], (0.8, 1.0), {"type": "thindielectric"}),
        outer=_sphere([0.1, 0.45, 0.3], 0.45, water),
        inner=_sphere([0.1, 0.45, 0.3], 0.25, bubble),
        frosted=_sphere([1.0, 0.4, 0.3], 0.4, {"type": "roughdielectric", "alpha": 0.2, "distribution": "beckmann"}),
    )


def principled():
    """Materials: glass, cloth, lacquer, brushed metal, and a thin leaf."""
    glass = {"type": "principled", "base_color": _rgb(0.9, 0.95, 0.9), "roughness": 0.3, "spec_trans": 0.8, "eta": 1.4}
    cloth = {"type": "principled", "base_color": _rgb(0.5, 0.1, 0.2), "sheen": 1.0, "sheen_tint": 0.5, "flatness": 0.5}
    metal = {"type": "principled", "base_color": _rgb(0.9, 0.6, 0.3), "metallic": 1.0, "roughness": 0.35}
    leaf = {"type": "principledthin", "base_color": _rgb(0.3, 0.6, 0.2), "spec_trans": 0.3, "diff_trans": 0.9}
    return stage(
        glass=_sphere([-0.8, 0.4, 0.3], 0.4, glass),
        cloth=_box([0.1, 0.3, -0.2], [0.6, 0.6, 0.6], 25, cloth | {"clearcoat": 0.8, "clearcoat_gloss": 0.6}),
        metal=_sphere([0.95, 0.4, 0.3], 0.4, metal | {"anisotropic": 0.7}),
        leaf=_wall([0.2, 0.75, 0.7], [0.2, 0.5, 1], (0.7, 0.5), leaf | {"eta": 1.5, "roughness": 0.4}),
    )


def bumps():
    """Bump and normal maps on a floor at a grazing angle, a mask, and a blend of gloss and matt."""
    gloss = {"type": "roughplastic", "alpha": 0.15, "diffuse_reflectance": _rgb(0.3, 0.4, 0.5), "nonlinear": True}
    bumpy = {"type": "bumpmap", "arbitrary": smooth(bitmap(8, 8, 1, channels=1), 2), "scale": 0.6, "bsdf": gloss}
    tilted = {
        "type": "normalmap",
        "normalmap": smooth(tilts(6, 2), 2),
        "bsdf": {"type": "roughconductor", "material": "Cu", "alpha": 0.25},
    }
    holes = {"type": "mask", "opacity": bitmap(5, 5, 3, channels=1), "nested": two(_diffuse(0.2, 0.6, 0.3))}
    mixed = {
        "type": "blendbsdf",
        "weight": bitmap(6, 6, 4, channels=1),
        "first": _diffuse(0.7, 0.5, 0.2),
        "second": {"type": "roughconductor", "material": "Al", "alpha": 0.2},
    }
    return stage(
        origin=(0.2, 0.45, 3.0),
        floor=_wall([0, 0, 0], [0, 1, 0], (6, 6), two(bumpy)),
        tilted=_wall([-0.9, 0.6, -0.3], [0.8, 0, 1], (1.0, 1.2), two(tilted)),
        holes=_wall([0.1, 0.5, 0.6], [0.1, 0, 1], (0.8, 0.7), holes),
        mixed=_sphere([0.9, 0.4, 0.2], 0.4, mixed),
    )


def tilts(side, seed):
    """Normals up to 30 degrees beside the surface's, as a normal map holds them."""
    n = np.random.default_rng(seed).uniform(-0.4, 0.4, (side, side, 3))
    n[..., 2] = 1
    n = (n / np.linalg.norm(n, axis=-1, keepdims=True) + 1) / 2
    return {"type": "bitmap", "bitmap": mi.Bitmap(n.astype(np.float32)), "raw": True}


def brushed():
    """Anisotropic metals of both distributions, textured roughness, and plastics."""

    def metal(material, distribution, **alpha):
        return {"type": "roughconductor", "material": material, "distribution": distribution, **alpha}

    patches = bitmap(4, 4, 5, 0.1, 0.5, channels=1)
    return stage(
        ggx=_sphere([-0.95, 0.4, 0.2], 0.4, metal("Au", "ggx", alpha_u=0.4, alpha_v=0.08)),
        beckmann={"type": "cylinder", "p0": [-0.2, 0.0, 0.0], "p1": [-0.2, 0.9, 0.0], "radius": 0.25}
        | {"bsdf": two(metal("Al", "beckmann", alpha_u=0.08, alpha_v=0.4))},
        patchy=_wall([0.5, 0.7, -0.6], [0, 0.2, 1], (0.8, 1.2), two(metal("Cr", "ggx", alpha=patches))),
        plastic=_sphere([0.75, 0.3, 0.7], 0.3, {"type": "plastic", "diffuse_reflectance": _rgb(0.6, 0.1, 0.1)}),
        mirror=_sphere([0.1, 0.2, 1.0], 0.2, {"type": "conductor", "material": "Ag"}),
    )


def hair():
    """Curves of both kinds, one with the material of hair, before a sky."""
    rng = np.random.default_rng(7)
    tufts = []
    for root in np.stack([rng.uniform(-0.9, 0.9, 24), np.zeros(24), rng.uniform(-0.6, 0.6, 24)], axis=1):
        bend = rng.uniform(-0.15, 0.15, 3)
        tufts.append([np.add(root, [bend[0] * k, 0.32 * k, bend[2] * k * k]) for k in range(5)])
    lines = ["\n".join("{:.4f} {:.4f} {:.4f} {:.4f}".format(*p, 0.035) for p in tuft) for tuft in tufts]
    fine = {"type": "hair", "eumelanin": 0.2, "pheomelanin": 0.4, "longitudinal_roughness": 0.4}
    return stage(
        tufts={"type": "bsplinecurve", "filename": written("even.txt", "\n\n".join(lines[::2]) + "\n")}
        | {"bsdf": {"type": "roughplastic", "alpha": 0.25}},
        straws={"type": "linearcurve", "filename": written("odd.txt", "\n\n".join(lines[1::2]) + "\n")}
        | {"bsdf": fine | {"azimuthal_roughness": 0.4}},
    )


def solids():
    """A surface in a grid of signed distances, instances, a disc and a ball that is turned inside out."""
    axis = np.linspace(-1, 1, 12)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    torus = np.sqrt((np.sqrt(x**2 + z**2) - 0.55) ** 2 + y**2) - 0.28
    group = {
        "type": "shapegroup",
        "a": _box([0, 0, 0], [0.3, 0.3, 0.3], 30, _diffuse(0.7, 0.3, 0.2)),
        "b": _sphere([0.1, 0.25, 0], 0.15, {"type": "roughconductor", "material": "Cu", "alpha": 0.3}),
    }
    places = [
        ([0.7, 0.15, 0.8], 20, [1, 1, 1]),
        ([1.0, 0.2, -0.2], 70, [1.4, 0.8, 1.4]),
        ([-0.1, 0.2, 1.0], 0, [0.6, 1.2, 0.6]),
    ]
    copies = {
        f"copy{i}": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": _transform().translate(at).rotate([0, 1, 0], angle).scale(size),
        }
        for i, (at, angle, size) in enumerate(places)
    }
    at = _transform().translate([-0.95, 0.1, 0.0]).scale([0.9, 0.9, 0.9])
    return {"type": "scene", "group": group | {"id": "group"}} | stage(
        torus={"type": "sdfgrid", "grid": mi.TensorXf(torus[..., None]), "to_world": at, "normals": "smooth"}
        | {"bsdf": two({"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _rgb(0.2, 0.4, 0.6)})},
        disc={"type": "disk", "to_world": _transform().translate([0.2, 0.6, -0.6]).rotate([1, 0.3, 0], -20).scale(0.5)}
        | {"bsdf": two({"type": "roughconductor", "material": "Al", "alpha": 0.2})},
        bowl=_sphere([0.35, 0.3, 0.3], 0.22, two(_diffuse(0.6, 0.6, 0.2))) | {"flip_normals": True},
        **copies,
    )


def facets():
    """Coarse meshes with smooth normals, seen at grazing angles, by a camera close to the floor."""
    return stage(
        origin=(0.1, 0.12, 2.4),
        target=(0, 0.35, 0),
        fov=60,
        matt=coarse_ball((-0.8, 0.45, 0.3), 0.45, 5, two(_diffuse(0.7, 0.6, 0.5))),
        gloss=coarse_ball((0.15, 0.35, 0.6), 0.35, 6, two({"type": "roughconductor", "material": "Al", "alpha": 0.2})),
        frosted=coarse_ball((0.9, 0.4, 0.2), 0.4, 6, {"type": "roughdielectric", "alpha": 0.3}),
        skin=coarse_ball(
            (0.3, 1.0, -0.6),
            0.5,
            6,
            two({"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": _rgb(0.2, 0.3, 0.6)}),
        ),
    )


def lamps():
    """Textured and mesh area lamps, a spot with a texture, a point, a direction and an image of a sky, together."""
    toward = _transform().look_at([1.5, 2, 2], [0.2, 0.2, 0], [0, 1, 0])
    sky = np.random.default_rng(4).random((8, 16, 3)) ** 3 * 1.5
    picture = {"emitter": {"type": "area", "radiance": bitmap(3, 5, 5, 0, 6)}}
    return stage(
        lamp=_wall([0.9, 1.8, 0.3], [-0.3, -1, 0], (1.0, 0.6), _diffuse(0.2, 0.2, 0.2)) | picture,
        glow=coarse_ball(
            (0.8, 0.3, 0.7), 0.25, 6, _diffuse(0.5, 0.2, 0.1), emitter={"type": "area", "radiance": _rgb(1.5, 2, 0.5)}
        ),
        tube={"type": "cylinder", "p0": [-1.4, 0.3, 0.4], "p1": [-1.2, 1.2, 0.2], "radius": 0.06}
        | {"emitter": {"type": "area", "radiance": _rgb(4, 3, 3)}},
        disc={"type": "disk", "to_world": _transform().look_at([-0.5, 1.7, 0.9], [-0.3, 0, 0], [0, 0, 1]).scale(0.2)}
        | {"emitter": {"type": "area", "radiance": _rgb(6, 6, 9)}},
        point={"type": "point", "position": [-0.8, 1.8, 1.5], "intensity": _rgb(1, 1.5, 2)},
        spot={"type": "spot", "to_world": toward, "intensity": _rgb(12, 9, 6), "cutoff_angle": 24, "beam_width": 6}
        | {"texture": bitmap(4, 4, 6)},
        sun={"type": "directional", "direction": [0.4, -1, -0.6], "irradiance": _rgb(0.6, 0.5, 0.3)},
        sky={
            "type": "envmap",
            "bitmap": mi.Bitmap(sky.astype(np.float32)),
            "to_world": _transform().rotate([0, 1, 0], 40),
        },
        ball=_sphere(
            [-0.4, 0.45, 0.1], 0.45, {"type": "roughconductor", "material": "Au", "alpha_u": 0.3, "alpha_v": 0.15}
        ),
    )


SCENES = [panes, principled, bumps, brushed, hair, solids, facets, lamps]
