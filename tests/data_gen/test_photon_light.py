"""What light photons bring: the power that lamps send, to where it is gathered, all of it as the radius goes to 0."""

from functools import partial

import numpy as np
import pytest
from lamps_scenes import lamps, lit_by
from references import references
from unbiased import differences, load, render_ours

KINDS = "picture", "glow", "point", "spot", "sun", "sky"


# ------------------------- The start of light paths -------------------------


def directions(n=256):
    """The middles of equal parts of all directions, (n * 2n, 3), and how large a part is."""
    z, φ = 2 * (np.arange(n) + 0.5) / n - 1, np.pi * (np.arange(2 * n) + 0.5) / n
    z, φ = (v.ravel() for v in np.meshgrid(z, φ, indexing="ij"))
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(φ), across * np.sin(φ), z]), 2 * np.pi / n**2


def power_of(mi, kind, scene, radius) -> np.ndarray:
    """Of a lamp, in each colour; of one that is far, what crosses a disk of that radius in every direction of it."""
    lamp = lamps()[kind]
    if kind == "picture":
        # A bilinear texture that is clamped: its mean is not that of its texels.
        u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 200] * 2)
        si = mi.SurfaceInteraction3f()
        si.uv, si.wi = mi.Point2f(u.ravel(), v.ravel()), mi.Vector3f(0, 0, 1)
        return np.pi * 0.8 * 0.5 * np.array(scene.emitters()[0].eval(si)).mean(axis=1)
    if kind == "glow":
        area = next(shape for shape in scene.shapes() if shape.is_emitter()).surface_area()[0]
        return np.pi * area * np.array([4, 5, 2])
    if kind == "sun":
        return np.pi * radius**2 * np.array([1, 0.8, 0.5])
    if kind == "sky":
        return 4 * np.pi**2 * radius**2 * np.array([0.2, 0.25, 0.4])
    if kind == "point":
        return 4 * np.pi * np.array([1.5, 2, 2.5])
    # A spot, by its intensity as Mitsuba has it at distance 1
    d, part = directions()
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.array(lamp["to_world"].matrix)[:3, 3]) + mi.Vector3f(d)
    _, intensity = scene.emitters()[0].sample_direction(it, mi.Point2f(0.5))
    return np.array(intensity).sum(axis=1) * part


@pytest.mark.parametrize("kind", KINDS)
def test_lamps_send_their_power(renderer, kind):
    """The mean of what light paths begin with is the power of the lamp, in each colour."""
    import drjit as dr

    from data_gen.paths.light_ends import LightEnds
    from data_gen.paths.streams import sample_streams

    mi = renderer
    scene = load(mi, lambda: lit_by(kind), (4, 4))
    lights = LightEnds(scene)
    random = sample_streams(0, dr.arange(mi.UInt32, 1 << 18), mi.UInt32(0))
    β = np.array(lights.sample(scene, random, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths).β, np.float64)
    β = np.broadcast_to(β, (3, β.shape[1]))
    mean, error = β.mean(axis=1), β.std(axis=1) / np.sqrt(1 << 18)
    power = power_of(mi, kind, scene, lights.radius)
    assert (np.abs(mean - power) < 4.5 * error + 2e-3 * power).all(), (mean, power, error)


# ------------------------- Where surfaces end -------------------------


def spread_at(mi, scene, points, radius, n=20000):
    """The mean of π r² / A at each of the ``points``, where z is the normal, over ``n`` passes; and its error."""
    import drjit as dr

    from data_gen.paths.light_ends import LightEnds
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.photons.map.edges import spread

    world, found = World(scene, LightEnds(scene), Materials(scene, 0.05)), []
    for p in points:
        x = dr.zeros(mi.SurfaceInteraction3f, n)
        x.p, x.n = mi.Point3f(*p) + dr.zeros(mi.Point3f, n), mi.Normal3f(0, 0, 1)
        values = np.array(spread(world, x, mi.Float(radius**2), dr.arange(mi.UInt32, n), mi.Bool(True)))
        found.append((values.mean(), values.std() / np.sqrt(n)))
    return np.array(found).T


def squares(*others):
    """A square of edge 2 about the origin, in z = 0, with others."""
    from data_gen.scenes.builtin import _camera, _diffuse

    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": _camera([0, 0, 4], [0, 0, 0], 40),
        "square": {"type": "rectangle", "bsdf": _diffuse(0.5, 0.5, 0.5)},
        "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0},
    }
    return scene | {f"other{i}": other for i, other in enumerate(others)}


def test_the_area_at_edges_is_that_of_geometry(renderer):
    """All of the disk, half of it, a quarter; a pane above changes nothing, nor does a wall that stands there."""
    import mitsuba as mi

    at = mi.ScalarTransform4f()
    pane = {"type": "rectangle", "to_world": at.translate([0, 0, 0.05]), "bsdf": {"type": "thindielectric"}}
    wall = {"type": "rectangle", "to_world": at.translate([0.02, 0, 0]).rotate([0, 1, 0], -90)}
    places, areas = [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [1, 2, 4]
    for others in ((), (pane,), (wall,)):
        scene = load(renderer, lambda others=others: squares(*others), (4, 4))
        mean, error = spread_at(renderer, scene, places, 0.2)
        # The sum ends with the 24th ray, two of which a probe through a pane takes.
        assert (np.abs(mean - areas) < 1e-3 + 4.5 * error + 0.04 * np.subtract(areas, 1)).all(), (others, mean)
        assert error[0] < 1e-6


def test_the_area_of_curved_and_bent_surfaces_is_that_of_geometry(renderer):
    """Of a sphere π r² of chords, and as much at a crease of 40 degrees; beyond 45 a face is another surface."""
    import mitsuba as mi

    from data_gen.scenes.builtin import _diffuse, _sphere

    at = mi.ScalarTransform4f()

    def bent(angle):
        """The square goes on beyond x = 1, turned down."""
        turn = at.translate([1, 0, 0]).rotate([0, 1, 0], angle).translate([1, 0, 0])
        return {"type": "rectangle", "to_world": turn, "bsdf": _diffuse(0.5, 0.5, 0.5)}

    ball = _sphere([0, 0, 4], 1, _diffuse(0.5, 0.5, 0.5))
    for other, place, area in ((ball, (0, 0, 5), 1), (bent(40), (1, 0, 0), 1), (bent(60), (1, 0, 0), 2)):
        scene = load(renderer, lambda other=other: squares(other), (4, 4))
        (mean,), (error,) = spread_at(renderer, scene, [place], 0.3)
        assert abs(mean - area) < 4.5 * error + 0.01, (place, mean, error)


def open_square(size=16):
    """A square that fills the film, evenly lit: its radiance is 0.5 / π."""
    scene = squares()
    to_world = scene["sensor"]["to_world"]
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene["sensor"] = {"type": "orthographic", "to_world": to_world, "film": film}
    return scene


@pytest.mark.parametrize("sampler", ["ppm", pytest.param("gpm", marks=pytest.mark.slow)])
def test_no_light_is_lost_along_edges(renderer, sampler):
    """Counted over all of the disk, a fifth of the light would be lost with a radius of a quarter of the square."""
    scene = load(renderer, open_square, (16, 16))
    stacks = render_ours(scene, sampler, batches=8, spp=1, radius=4.0, photons=32)
    image = np.mean([stack["primal"] for stack in stacks], axis=0) / (0.5 / np.pi)
    assert abs(image.mean() - 1) < 0.01, image.mean()
    # By columns: the outermost, whose disks are cut in half, and the middle
    columns = image.mean(axis=(0, 2))
    assert np.abs(columns - 1).max() < 0.15, columns
    if sampler == "gpm":
        slopes = np.mean([stack["dx"] for stack in stacks], axis=0).mean(axis=(0, 2)) / (0.5 / np.pi)
        assert np.abs(slopes).max() < 0.15, slopes


# ------------------------- As the radius goes to 0 -------------------------


def off(stacks, references, layer="primal", block=8):
    """How far the mean of ``stacks`` is from that of images: energy, its error, blocks (root mean square), their noise.

    All over the mean of the image. Blocks are without their noise, as far as that is known.
    """
    images = np.stack([stack[layer] for stack in stacks])
    others = (
        references if layer == "primal" else np.stack([differences(one)["xy".index(layer[1])] for one in references])
    )
    mean, d, variance = references.mean(), [], []
    for some in (images, others):
        n, height, width, _ = some.shape
        blocks = some.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4)) / mean
        d.append(blocks.mean(axis=0))
        variance.append(blocks.var(axis=0, ddof=1) / n)
    noise2, energies = (
        np.mean(variance[0] + variance[1]),
        [some.mean(axis=(1, 2, 3)) / mean for some in (images, others)],
    )
    error = np.sqrt(sum(some.var(ddof=1) / len(some) for some in energies))
    square = np.mean((d[0] - d[1]) ** 2) - noise2
    return energies[0].mean() - energies[1].mean(), error, np.sqrt(max(square, 0)), np.sqrt(noise2)


def assert_goes_to_zero(wide, narrow, much=0.01):
    """What is off with a quarter of the radius is little, and no more than half of what was."""
    (energy, energy_error, blocks, _), (left, error, blocks_left, noise) = wide, narrow
    assert abs(left) < much + 4 * error, (energy, left, error)
    assert abs(left) < 0.5 * abs(energy) + 4 * np.hypot(error, energy_error), (energy, left, error)
    assert blocks_left < 0.5 * blocks + noise, (blocks, blocks_left, noise)


# Light paths for each pixel, and whether there is fog
SAMPLERS = {
    "ppm": (64, False),
    "gpm": (8, False),
    "vcm": (None, False),
    "gvcm": (None, False),
    "vpm": (64, True),
    "gvpm": (8, True),
    "bre": (64, True),
    "gbre": (8, True),
    "beams": (4, True),
    "gbeams": (2, True),
    "planes": (4, True),
    "gplanes": (2, True),
}


@pytest.mark.slow
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_bias_goes_to_zero_with_the_radius(renderer, sampler):
    """Of images under lamps of all kinds, and of their differences: what Mitsuba's integrators do not have goes."""
    photons, fog = SAMPLERS[sampler]
    scene = load(renderer, lambda: lit_by(fog=fog), (48, 32))
    expected = references(renderer, partial(lit_by, fog=fog), (48, 32))
    options = {"spp": 16} if photons is None else {"spp": 1, "photons": photons}
    wide, narrow = (render_ours(scene, sampler, batches=16, radius=r, **options) for r in (4.0, 1.0))
    for layer in ("primal", "dx", "dy"):
        if layer in wide[0]:
            assert_goes_to_zero(off(wide, expected, layer), off(narrow, expected, layer))


def test_photons_of_all_lamps_bring_the_light_of_paths(renderer):
    """With a small radius, where all are lit together: what is lost or counted twice of any lamp stands out."""
    scene = load(renderer, lit_by, (48, 32))
    expected = references(renderer, partial(lit_by, fog=False), (48, 32))
    energy, error, blocks, noise = off(render_ours(scene, "ppm", 12, spp=1, radius=1.0, photons=64), expected)
    assert abs(energy) < 0.005 + 4 * error and error < 0.006, (energy, error)
    assert blocks < 0.03 + noise, (blocks, noise)
