"""What light photons bring: the power of lamps, also along edges, and the light of paths as the radius goes to 0."""

from functools import partial

import numpy as np
import pytest
from lamps_scenes import lamps, lit_by
from photon_laws import world_of
from references import references
from renders import dr, mi
from unbiased import differences, load, render_ours

from data_gen.paths.light_ends import LightEnds
from data_gen.paths.streams import sample_streams
from data_gen.samplers.photons.map.radius import spread
from data_gen.scenes.builtin import _camera, _diffuse

# ------------------------- The start of light paths -------------------------


def power_of(kind, scene, radius):
    """The power of a lamp, in each colour; for one that is far, what crosses a disk of that radius each way."""
    if kind == "picture":
        # A bilinear texture that is clamped: its mean is not that of its texels.
        u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 200] * 2)
        si = mi.SurfaceInteraction3f()
        si.uv, si.wi = mi.Point2f(u.ravel(), v.ravel()), mi.Vector3f(0, 0, 1)
        return np.pi * 0.8 * 0.5 * np.array(scene.emitters()[0].eval(si)).mean(axis=1)
    if kind == "spot":
        # By its intensity as Mitsuba has it at distance 1, over equal parts of all directions
        z, φ = np.meshgrid((np.arange(256) - 127.5) / 128, np.pi * (np.arange(512) + 0.5) / 256, indexing="ij")
        d, it = np.stack([np.sqrt(1 - z**2) * np.cos(φ), np.sqrt(1 - z**2) * np.sin(φ), z]), mi.Interaction3f()
        it.p = mi.Point3f(np.array(lamps()[kind]["to_world"].matrix)[:3, 3]) + mi.Vector3f(d.reshape(3, -1))
        return 4 * np.pi * np.array(scene.emitters()[0].sample_direction(it, mi.Point2f(0.5))[1]).mean(axis=1)
    area = next((shape.surface_area()[0] for shape in scene.shapes() if shape.is_emitter()), 0)
    return (
        np.pi
        * {
            "glow": area * np.array([4, 5, 2]) * (shining(scene) if kind == "glow" else 1),
            "sun": radius**2 * np.array([1, 0.8, 0.5]),
            "sky": 4 * np.pi * radius**2 * np.array([0.2, 0.25, 0.4]),
            "point": 4 * np.array([1.5, 2, 2.5]),
        }[kind]
    )


@pytest.mark.parametrize("kind", ["picture", "glow", "point", "spot", "sun", "sky"])
def test_lamps_send_their_power(renderer, kind):
    """The mean of what light paths begin with is the power of the lamp, in each colour."""
    everything = lit_by()
    scene = load(mi, {name: part for name, part in everything.items() if name == kind or name not in lamps()})
    lights, random = LightEnds(scene), sample_streams(0, dr.arange(mi.UInt32, 1 << 18), mi.UInt32(0))
    β = np.array(lights.sample(scene, random, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths).β, np.float64)
    β = np.broadcast_to(β, (3, β.shape[1]))
    mean, error, power = β.mean(axis=1), β.std(axis=1) / np.sqrt(1 << 18), power_of(kind, scene, lights.radius)
    assert (np.abs(mean - power) < 4.5 * error + 2e-3 * power).all(), (mean, power, error)


def shining(scene):
    """The share of a bent lamp's power that it sends: what is in front of its vertex normals, as Mitsuba has it."""
    (lamp,) = (shape for shape in scene.shapes() if shape.is_emitter())
    params, rng = mi.traverse(lamp), np.random.default_rng(0)
    faces = np.array(params["faces"]).reshape(-1, 3)
    p, n = (np.array(params[f"vertex_{name}"], np.float64).reshape(-1, 3)[faces] for name in ("positions", "normals"))
    across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(across, axis=-1)
    face = rng.choice(len(faces), 1 << 18, p=area / area.sum())
    b = rng.dirichlet([1, 1, 1], len(face))
    d = rng.standard_normal((len(face), 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    cos = np.maximum((d * across[face]).sum(axis=1) / area[face], 0)
    return (cos * ((d * np.einsum("fv,fvi->fi", b, n[face])).sum(axis=1) > 0)).sum() / cos.sum()


# ------------------------- Where surfaces end -------------------------


def squares(*others):
    """A square of edge 2 about the origin, in z = 0, with others."""
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": _camera([0, 0, 4], [0, 0, 0], 40),
        "square": {"type": "rectangle", "bsdf": _diffuse(0.5, 0.5, 0.5)},
        "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0},
    }
    return scene | {f"other{i}": other for i, other in enumerate(others)}


def pane():
    """Above the square; and a wall stands on it."""
    at = mi.ScalarTransform4f()
    wall = {"type": "rectangle", "to_world": at.translate([0.02, 0, 0]).rotate([0, 1, 0], -90)}
    return {"type": "rectangle", "to_world": at.translate([0, 0, 0.05]), "bsdf": {"type": "thindielectric"}}, wall


def bent(angle):
    """The square goes on beyond x = 1, turned down."""
    turn = mi.ScalarTransform4f().translate([1, 0, 0]).rotate([0, 1, 0], angle).translate([1, 0, 0])
    return [{"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse"}}]


def ball():
    return [{"type": "sphere", "center": [0, 0, 4], "radius": 1.0, "bsdf": {"type": "diffuse"}}]


@pytest.mark.parametrize(
    ("others", "places"),
    [
        # All of the disk, half of it, a quarter; what is above changes nothing.
        (tuple, {(0, 0, 0): 1, (1, 0, 0): 2, (1, 1, 0): 4}),
        (pane, {(0, 0, 0): 1, (1, 0, 0): 2, (1, 1, 0): 4}),
        # Of a sphere π r² of chords, and as much at a crease of 40 degrees; beyond 45 a face is another surface.
        (ball, {(0, 0, 5): 1}),
        (partial(bent, 40), {(1, 0, 0): 1}),
        (partial(bent, 60), {(1, 0, 0): 2}),
    ],
)
def test_the_area_at_edges_is_that_of_geometry(renderer, others, places):
    """The mean of π r² / A at places where z is the normal, over passes."""
    mi, n, radius = renderer, 20000, 0.3 if others not in (tuple, pane) else 0.2
    world = world_of(load(mi, lambda: squares(*others()), (4, 4)))
    for p, area in places.items():
        x = dr.zeros(mi.SurfaceInteraction3f, n)
        x.p, x.n = mi.Point3f(*p) + dr.zeros(mi.Point3f, n), mi.Normal3f(0, 0, 1)
        found = np.array(spread(world, x, mi.Float(radius**2), dr.arange(mi.UInt32, n), mi.Bool(True)))
        error = found.std() / np.sqrt(n)
        # The sum ends with the 24th ray, two of which a probe through a pane takes.
        allowed = 4.5 * error + (0.01 if others not in (tuple, pane) else 1e-3 + 0.04 * (area - 1))
        assert abs(found.mean() - area) < allowed, (p, found.mean(), error)
        assert error < 1e-6 or p != (0, 0, 0)


def open_square():
    """A square that fills the film, evenly lit: its radiance is 0.5 / π."""
    scene = squares()
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return scene | {
        "sensor": {"type": "orthographic", "to_world": scene["sensor"]["to_world"], "film": film},
    }


def test_no_light_is_lost_along_edges(renderer):
    assert_no_light_is_lost_along_edges(renderer, "ppm")


def assert_no_light_is_lost_along_edges(renderer, sampler):
    """Counted over all of the disk, a fifth of the light would be lost with a radius of a quarter of the square.

    Returns the stacks in which that was looked for.
    """
    scene = load(renderer, open_square, (16, 16))
    stacks = render_ours(scene, sampler, batches=8, spp=1, radius=4.0, photons=32)
    # By columns: the outermost, whose disks are cut in half, and the middle
    columns = np.mean([stack["primal"] for stack in stacks], axis=(0, 1, 3)) / (0.5 / np.pi)
    assert abs(columns.mean() - 1) < 0.01 and np.abs(columns - 1).max() < 0.15, columns
    return stacks


# ------------------------- As the radius goes to 0 -------------------------


def off(stacks, references, layer="primal", block=8):
    """How far the mean of ``stacks`` is from that of images: energy, its error, blocks (root mean square), their noise.

    All over the mean of the image. Blocks are without their noise, as far as that is known.
    """
    ours, theirs, mean = np.stack([stack[layer] for stack in stacks]), references, references.mean()
    if layer != "primal":
        theirs = np.stack([differences(one)["xy".index(layer[1])] for one in references])
    means, noise2, error2 = [], 0, 0
    for images in (ours, theirs):
        n, height, width, _ = images.shape
        blocks = images.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4)) / mean
        means.append(blocks.mean(axis=0))
        noise2 += np.mean(blocks.var(axis=0, ddof=1)) / n
        error2 += (images.mean(axis=(1, 2, 3)) / mean).var(ddof=1) / n
    square = np.mean((means[0] - means[1]) ** 2) - noise2
    return (ours.mean() - theirs.mean()) / mean, np.sqrt(error2), np.sqrt(max(square, 0)), np.sqrt(noise2)


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "photons", "fog"), [("ppm", 64, False), ("vcm", None, False), ("bre", 64, True)])
def test_bias_goes_to_zero_with_the_radius(renderer, sampler, photons, fog):
    assert_bias_goes_to_zero(renderer, sampler, photons, fog)


def assert_bias_goes_to_zero(renderer, sampler, photons, fog):
    """The bias of images under lamps of all kinds, and of their differences: what is off with a quarter of the radius
    is little, and no more than half of what was.

    ``photons``: light paths for each pixel; None: of ``vcm``, one for each sample.
    """
    scene = load(renderer, lambda: lit_by(fog=fog), (48, 32))
    expected = references(renderer, partial(lit_by, fog=fog), (48, 32))
    options = {"spp": 16} if photons is None else {"spp": 1, "photons": photons}
    wide, narrow = (render_ours(scene, sampler, batches=16, radius=r, **options) for r in (4.0, 1.0))
    for layer in ("primal", "dx", "dy"):
        if layer in wide[0]:
            energy, energy_error, blocks, _ = off(wide, expected, layer)
            left, error, blocks_left, noise = off(narrow, expected, layer)
            assert abs(left) < 0.01 + 4 * error, (energy, left, error)
            assert abs(left) < 0.5 * abs(energy) + 4 * np.hypot(error, energy_error), (energy, left, error)
            assert blocks_left < 0.5 * blocks + noise, (blocks, blocks_left, noise)


def test_photons_of_all_lamps_bring_the_light_of_paths(renderer):
    """With a small radius, where all are lit together: what is lost or counted twice of any lamp stands out."""
    scene = load(renderer, lit_by, (48, 32))
    expected = references(renderer, partial(lit_by, fog=False), (48, 32))
    energy, error, blocks, noise = off(render_ours(scene, "ppm", 12, spp=1, radius=1.0, photons=64), expected)
    assert abs(energy) < 0.005 + 4 * error and error < 0.006, (energy, error)
    assert blocks < 0.03 + noise, (blocks, noise)
