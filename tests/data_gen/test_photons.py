"""What is particular to photons: the grid, maps and their vertices, radii, and ``ppm``, which is biased and converges.

That ``ppm`` repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers.
"""

import numpy as np
import pytest
from bdpt_scenes import SCENES
from unbiased import light_of_gradients, load, render_ours

from ngpt.errors import Interrupted, NgptError


@pytest.mark.parametrize("radius", [0.3, 0.05, 0.004])
def test_the_grid_finds_what_brute_force_finds(renderer, radius):
    """Each once, on and beyond the box too; with the least radius cells are larger than they need be."""
    from data_gen.samplers.photons.map.grid import Grid

    mi, rng = renderer, np.random.default_rng(0)
    points = rng.random((3000, 3)).astype(np.float32) * [2, 1, 0.2] - [1, 0, 0]
    exist = rng.random(3000) < 0.8
    queries = np.concatenate(
        [points[:600] + rng.normal(size=(600, 3)) * radius, rng.random((100, 3)) * 6 - 3, points[:9]]
    )
    grid = Grid(mi.Point3f(points.T), mi.Bool(exist), radius)
    assert grid.edge[0] >= 2 * radius and (radius > 0.01 or grid.edge[0] > 3 * radius)
    numbers = mi.UInt32(np.arange(1, 3001))

    def light(i, near):
        import drjit as dr

        return dr.select(near, dr.gather(mi.UInt32, numbers, dr.gather(mi.UInt32, grid.index, i, near), near), 0)

    p = mi.Point3f(queries.T)
    active = np.arange(len(queries)) % 7 != 0
    found = np.array(grid.gather(p, mi.Float(radius**2), mi.Bool(active), light, mi.UInt32(np.zeros(len(queries)))))
    near = ((queries.astype(np.float32)[:, None] - points.astype(np.float32)) ** 2).sum(axis=-1) < radius**2
    assert np.array_equal(found, (near & exist & active[:, None]) @ np.arange(1, 3001)) and (near.sum() > 100)


def test_an_empty_grid(renderer):
    from data_gen.samplers.photons.map.grid import Grid

    mi = renderer
    grid = Grid(mi.Point3f(np.zeros((3, 4))), mi.Bool([False] * 4), 0.1)
    found = grid.gather(mi.Point3f(0), mi.Float(0.01), mi.Bool(True), lambda i, near: mi.Float(near), mi.Float(0))
    assert not np.array(found).any()


def maps_of(mi, scene, paths=4096, max_depth=6):
    """The maps of so many light paths, and the light's end of them."""
    import drjit as dr

    from data_gen.paths.light_ends import LightEnds
    from data_gen.paths.streams import sample_streams
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.photons.map.trace import trace

    random = sample_streams(0, dr.arange(mi.UInt32, paths), mi.UInt32(0))
    start, maps = trace(World(scene, LightEnds(scene), Materials(scene, 0.05)), random, max_depth, 4)
    return start, list(maps)


def entries(photons, *names):
    """Fields of the vertices of a map, and the rows of their parents among them; other places of the map are empty."""
    exists = np.array(photons.t) > 0
    values = [np.array(getattr(photons, name)).T[exists] for name in names]
    row, parent = np.cumsum(exists) - 1, np.array(photons.parent)[exists]
    first = np.array(photons.density)[exists] == 0
    # Parents of those that begin a further map are in the one before.
    known = np.where(first, 0, np.minimum(parent, len(row) - 1))
    return *values, np.where(first, parent, row[known]), first


def test_vertices_know_their_parents(renderer):
    """From the parent a vertex lies along its direction; what the ray met there is found again."""
    mi = renderer
    scene = load(mi, SCENES["glass"], (8, 8))
    start, (photons,) = maps_of(mi, scene)
    p, n, d, t, depth, parent, first = entries(photons, "p", "n", "d", "t", "depth")
    assert 0 < first.sum() <= 4096 and (parent[~first] < np.flatnonzero(~first)).all()
    origin = np.where(first[:, None], np.array(start.ray.o).T[parent * first], p[parent * ~first])
    assert np.abs(origin + d * t[:, None] - p).max() < 1e-3
    known = ~first & (depth > 0) & (depth[parent] > 0)
    assert known.any() and (depth[known] == depth[parent[known]] + 1).all()
    assert (depth == 0).mean() > 0.05  # on glass
    from data_gen.samplers.photons.map.vertices import vertex_of

    si = vertex_of(photons, mi.UInt32(np.flatnonzero(np.array(photons.t) > 0)))
    assert np.abs(np.array(si.p).T - p).max() < 1e-4
    assert ((np.array(si.n).T * n).sum(axis=1) > 0.999).mean() > 0.999
    assert np.array(si.is_valid()).all()


def test_maps_of_many_vertices_are_cut(renderer, monkeypatch):
    """Into some, which have the same photons each once, whose parents are with them."""
    from data_gen.samplers.photons.map import trace

    mi = renderer
    scene = load(mi, "diffuse", (8, 8))
    _, (whole,) = maps_of(mi, scene)
    monkeypatch.setattr(trace, "VERTICES_PER_PATH", 2)
    _, parts = maps_of(mi, scene)
    assert len(parts) > 2
    for name in ("p", "β", "d"):

        def gathered(part, name=name):
            value, depth, *_ = entries(part, name, "depth")
            return value[depth > 0]

        together = np.concatenate([gathered(part) for part in parts])
        assert np.allclose(np.sort(together, axis=0), np.sort(gathered(whole), axis=0), rtol=1e-3, atol=1e-4)
    for part in parts:
        p, d, t, depth, parent, first = entries(part, "p", "d", "t", "depth")
        some = ~first & (depth > 0)
        assert np.abs(p[parent[some]] + (d * t[:, None] - p)[some]).max(initial=0) < 1e-3


def test_kernels_are_recorded_once_and_make_the_same_bits(renderer, monkeypatch, recordings):
    """As if they were recorded in each pass."""
    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.paths.frozen import Frozen
    from data_gen.samplers import find

    scene = load(renderer, "diffuse", (16, 12))
    sensor = scene.sensors()[0]

    def rendered(others=()):
        passes, film = find("gpm").made(scene), GradientFilm(16, 12, batches=True)
        for i in range(3):
            with recording():
                passes(CameraSamples(sensor, 3, 1, i), film)
                film.end_pass(1)
            others = [load(renderer, other, (4, 4)) for other in others] if i == 0 else []
        return film.develop()

    layers = rendered()
    # A function is recorded again where two arrays happen to be of one size, or of size 1.
    assert len(recordings.of) > 8 and recordings.total() <= len(recordings.of) + 2
    # Other scenes come and go.
    with_others = rendered([SCENES["areas"]])
    monkeypatch.setattr(Frozen, "__call__", lambda self, f, *args: f(*args))
    anew = rendered()
    assert layers.keys() == anew.keys()
    for name in layers:
        assert np.array_equal(layers[name], anew[name]) and np.array_equal(layers[name], with_others[name]), name


@pytest.mark.parametrize("kind", [KeyboardInterrupt, Interrupted])
def test_an_interrupt_while_a_plugin_is_made_is_one(renderer, monkeypatch, kind):
    """Mitsuba makes a text of what a plugin raises."""
    from data_gen.samplers import find
    from data_gen.samplers.photons.surfaces.ppm import PPM

    def interrupted(self, props):
        raise kind

    scene = load(renderer, "diffuse", (4, 4))
    monkeypatch.setattr(PPM, "__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        find("ppm").made(scene)


def test_radii_shrink_as_told():
    from data_gen.samplers.photons.map.radius import ALPHA, shrunk

    r2 = 1.0
    for i in range(50):
        assert shrunk(i) == pytest.approx(r2**0.5, rel=1e-9)
        r2 *= (i + 1 + ALPHA) / (i + 2)
    assert shrunk(10**8) ** 2 == pytest.approx(shrunk(10**5) ** 2 * 1e3 ** (ALPHA - 1), rel=1e-3)


def assert_alike(images, references, block):
    """Means of blocks differ by no more than 4 standard errors and 3 % of the image, which may be bias."""

    def blocks(stack):
        n, height, width, _ = stack.shape
        x = stack.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4))
        return x.mean(axis=0), x.var(axis=0, ddof=1) / n

    (ours, ours_var), (theirs, theirs_var) = blocks(images), blocks(references)
    off = np.abs(ours - theirs) - 4 * np.sqrt(ours_var + theirs_var)
    assert off.max() < 0.03 * theirs.mean(), (off.max(), theirs.mean())


@pytest.mark.parametrize("name", ["areas", "sky", "glass", pytest.param("points", marks=pytest.mark.slow)])
def test_small_radii_have_the_image_of_paths(renderer, name):
    """All lights and chains; within what a radius of a third of a pixel blurs. Of points, that of ``bdpt``."""
    scene = load(renderer, SCENES[name], (24, 24))
    ours = render_ours(scene, "ppm", batches=12, spp=1, radius=0.3, photons=64)
    theirs = render_ours(scene, "bdpt" if name == "points" else "primal", batches=12, spp=64)
    # Lamps that are seen directly have edges, of which ``ours`` have 12 samples a pixel.
    images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
    assert_alike(images, references, 6)
    assert references.mean() > 0.01


def test_it_converges(renderer):
    """The error of the mean over n passes falls like n^-α or faster: 0.84 as measured over 2 to 128 passes."""
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (24, 24))
    reference = np.array(renderer.render(scene, spp=4096))

    def error(n):
        x = render_stack(scene, n, 0, "ppm", photons=4, radius=1.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 2, 8, 32
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < -0.6


def test_a_wide_radius_is_biased(renderer):
    """Light of a pixel's neighbourhood is gathered: what the laws of other samplers call a failure."""
    scene = load(renderer, "diffuse", (24, 24))
    references = np.stack([light_of_gradients(s) for s in render_ours(scene, "primal", batches=12, spp=64)])
    ours = render_ours(scene, "ppm", batches=12, spp=1, radius=4.0, photons=16)
    with pytest.raises(AssertionError):
        assert_alike(np.stack([light_of_gradients(s) for s in ours]), references, 6)


@pytest.mark.parametrize("max_depth", [1, 2, 4])
def test_paths_are_no_longer_than_the_scene_says(renderer, max_depth):
    def short():
        return SCENES["glass"]() | {"integrator": {"type": "path", "max_depth": max_depth}}

    scene = load(renderer, short, (16, 16))
    ours = render_ours(scene, "ppm", batches=12, spp=1, radius=0.3, photons=64)
    theirs = render_ours(scene, "primal", batches=12, spp=64)
    images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
    if max_depth == 1:
        assert not images.any() and not references.any()
    else:
        assert_alike(images, references, 4)


def test_light_that_only_photons_find(renderer):
    """What a point lights through glass: ``path`` is black there, and photons bring half of the light."""

    def ball_on_the_floor():
        ball = {"type": "sphere", "center": [0, 1, 0], "radius": 1.0, "bsdf": {"type": "dielectric"}}
        point = {"type": "point", "position": [0, 4, 0], "intensity": 5.0}
        scene = {
            key: value for key, value in SCENES["points"]().items() if key in ("type", "integrator", "sensor", "floor")
        }
        return scene | {"ball": ball, "point": point}

    scene = load(renderer, ball_on_the_floor, (16, 16))
    ours, theirs = (render_ours(scene, name, 1, 8)[0]["primal"] for name in ("ppm", "primal"))
    assert ours.mean() > 1.2 * theirs.mean()


def test_maps_larger_than_memory_are_refused_with_what_fits(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (128, 128))
    with pytest.raises(NgptError, match=r"pass --memory \d+, or .* or no more than -O photons=(\d+)") as caught:
        render_stack(scene, 1, 0, "ppm", memory=400, photons=64)
    words = str(caught.value)
    fits, needed = int(words.rsplit("=", 1)[1]), int(words.split("--memory ")[1].split(",")[0])
    assert 1 < fits < 64 and needed > 400
    render_stack(scene, 1, 0, "ppm", memory=400, photons=fits)
    with pytest.raises(NgptError, match=r"render a smaller image$"):
        render_stack(scene, 1, 0, "ppm", memory=20)


def test_variants_that_photons_refuse(renderer):
    from data_gen.backend import use_variant
    from data_gen.render import render_stack

    try:
        use_variant("llvm_ad_spectral")
        with pytest.raises(NgptError, match=r"paths share light, as variant 'llvm_ad_rgb' allows; use --sampler gpt"):
            render_stack(load(renderer, "diffuse", (8, 8)), 1, 0, "ppm")
        use_variant("llvm_ad_mono")
        assert render_stack(load(renderer, "diffuse", (8, 8)), 2, 0, "ppm")["primal"].mean() > 0.01
    finally:
        use_variant()


def test_a_scene_without_lamps_is_black_for_photons(renderer):
    from data_gen.render import render_stack

    def dark():
        return {key: value for key, value in SCENES["points"]().items() if key not in ("point", "spot", "sun")}

    stack = render_stack(load(renderer, dark, (8, 8)), 4, 0, "ppm")
    assert not stack["primal"].any() and stack["albedo"].any()
