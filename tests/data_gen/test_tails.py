"""Paths that end in a cache: which vertices may, that no bit depends on passes, and that differences are the image's.

How large the bias is where light may leak is in ``test_tails_leaks``.
"""

import logging
from functools import lru_cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from media_scenes import nested
from rendered_once import rendered_once
from shared_tails import blocks, whole_paths
from tails_scenes import bulb, mirrors, slit
from unbiased import light_of_gradients, load, stacks_of

import data_gen
import ngpt
from data_gen import passes
from data_gen.adaptive import Adaptive
from data_gen.render import render_stack
from data_gen.samplers.gpt import rounds
from data_gen.scenes import builtin
from data_gen.tails import cache, schedule
from data_gen.tails.cache import LEAST
from data_gen.tails.matt import is_lambertian
from data_gen.tails.schedule import FINENESS
from data_gen.tails.table import CellPlace
from ngpt.classical.gradients import forward_differences
from ngpt.errors import NgptError, WrongUse
from ngpt.shared import shared_variance

pytestmark = pytest.mark.usefixtures("small_images_share")

DIFFUSE = {"type": "diffuse"}
ROUGH = {"type": "roughconductor", "alpha": 0.4}
# Materials; whether a path may end there, and whether nothing is left to follow then
MATERIALS = {
    "diffuse": (DIFFUSE, True, True),
    "two-sided": ({"type": "twosided", "material": DIFFUSE}, True, True),
    "bumpy": ({"type": "bumpmap", "bumps": {"type": "checkerboard"}, "material": DIFFUSE}, True, False),
    "rough plastic": ({"type": "roughplastic", "alpha": 0.3}, True, False),
    "plastic": ({"type": "plastic"}, True, False),
    "metal": ({"type": "conductor"}, False, False),
    "rough metal": (ROUGH, False, False),
    "glass": ({"type": "dielectric"}, False, False),
    "rough glass": ({"type": "roughdielectric", "alpha": 0.5}, False, False),
    "pane": ({"type": "thindielectric"}, False, False),
    "principled": ({"type": "principled", "roughness": 0.7}, True, False),
    "leaf": ({"type": "principledthin", "roughness": 0.7, "diff_trans": 0.5}, True, False),
    "mask": ({"type": "mask", "opacity": 0.5, "material": DIFFUSE}, True, False),
    "blend": ({"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": ROUGH}, True, False),
    "hole": ({"type": "null"}, False, False),
    "hair": ({"type": "hair"}, False, False),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_paths_end_only_at_diffuse_parts(renderer, name):
    description, ends, lambertian = MATERIALS[name]
    material = renderer.load_dict(description)
    assert mi.has_flag(material.flags(), mi.BSDFFlags.DiffuseReflection) == ends
    assert is_lambertian(material) == lambertian


# Records
N = 20_000


def flat(x, y):
    """Places on a floor."""
    return CellPlace(mi.Point3f(x, y, 0.02), mi.UInt32(0), mi.Int32(-3))


def known(place, values, unit=0.0, at=None):
    """What a cache of these records knows at their places: RGB, half the difference of its halves, whether it is known.

    Every other record goes into the second half. The first records choose the ``unit`` of sums if it is 0.
    """
    filled = cache.Cache(FINENESS)
    filled.unit = unit
    filled.add(place, dr.arange(mi.UInt32, dr.width(values)) & 1, values)
    filled.settle(FINENESS)
    (light,), (difference,), found = filled.known.look(at or place, LEAST, mi.Bool(True))
    return np.array(light, np.float64), np.array(difference, np.float64), np.array(found)


def test_what_is_known_depends_on_no_order(renderer):
    """The sums are integers, and each cell judges those within it whatever lane they came from."""
    rng = np.random.default_rng(3)
    p, value = rng.random((3, N)).astype(np.float32), rng.exponential(1, (3, N)).astype(np.float32)
    p[2] *= 0.05
    code, level, order = rng.integers(0, 4, N), rng.integers(-4, -2, N), rng.permutation(N // 2)

    def part(pairs):
        which = np.stack([2 * pairs, 2 * pairs + 1], axis=1).ravel()
        place = CellPlace(mi.Point3f(p[:, which]), mi.UInt32(code[which]), mi.Int32(level[which]))
        return place, [mi.Float(v[which]) for v in value], 2.0**-26

    everywhere = part(np.arange(N // 2))
    light, difference, found = known(*everywhere)
    others = known(*part(order), at=everywhere[0])
    assert all(np.array_equal(a, b) for a, b in zip((light, difference, found), others, strict=True))
    assert 0.2 < found.mean() <= 1
    # The means of exponential numbers are near 1.
    assert abs(light[:, found].mean() - 1) < 0.05


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e12])
def test_what_is_known_has_all_the_light(renderer, scale):
    """Also where one record in thousands brings a tenth of it, and where a colour is below 0."""
    u, v, light = np.random.default_rng(1).random((3, N)).astype(np.float32)
    light[5] = 1e3
    place, light = flat(u, v), scale * mi.Float(light)
    (red, green, blue), _, found = known(place, [light, 0.5 * light, -0.25 * light])
    assert np.allclose(green, 0.5 * red, rtol=1e-4) and np.allclose(blue, -0.25 * red, rtol=1e-4)
    # All cells have enough records in both halves, which count alike whatever their numbers.
    assert found.all() and red.sum() == pytest.approx(np.array(light, np.float64).sum(), rel=0.1)


def test_half_the_difference_is_a_sample_of_the_error(renderer):
    """Its mean square over cells is the mean squared error of what is known."""
    rng = np.random.default_rng(2)
    u, v = rng.random((2, 4 * N)).astype(np.float32)
    place, value = flat(u, v), mi.Float(rng.exponential(1, 4 * N).astype(np.float32))
    (red, *_), (difference, *_), found = known(place, [value, value, value])
    cells, first = np.unique(red[found], return_index=True)
    errors, samples = np.square(cells - 1), np.square(difference[found][first])
    assert len(cells) > 50 and samples.mean() == pytest.approx(errors.mean(), rel=0.5)


# Parts of all light, and how many times the mean a record may bring
@pytest.mark.parametrize(("parts", "times"), [(200, cache.MOST), (2, N / 2)])
def test_one_record_cannot_bring_most_of_the_light(renderer, monkeypatch, parts, times):
    monkeypatch.setattr(cache, "PARTS", parts)
    filled, values = cache.Cache(FINENESS), np.ones(N, np.float32)
    values[5] = 1e6
    place = flat(dr.full(mi.Float, 0.5, N), 0.5)
    filled.add(place, dr.arange(mi.UInt32, N) & 1, [mi.Float(values), mi.Float(0.5 * values), mi.Float(0)])
    filled.settle(FINENESS)
    ((red, green, _),), *_ = filled.known.look(place, LEAST, mi.Bool(True))
    kept = N - 1 + max(times, N / parts) * values.mean()
    assert red[0] == pytest.approx(kept / N, rel=1e-3) and green[0] == pytest.approx(0.5 * red[0], rel=1e-3)
    assert filled.cut / filled.light == pytest.approx(1 - kept / values.sum(), rel=1e-3)


METAL = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": 0.8}}
PLASTIC = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.9}}
DARK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.002}}


def room_of(walls, floor):
    """The built-in room, whose lamp has 14, of other materials. All paths play Russian roulette."""
    scene = builtin.diffuse()
    for name, part in scene.items():
        if isinstance(part, dict) and "bsdf" in part and name != "lamp":
            part["bsdf"] = floor if name == "floor" else walls
    return scene | {"integrator": {"type": "path", "rr_depth": 1}}


def test_records_on_dark_surfaces_are_no_fireflies(renderer, monkeypatch):
    """Behind a record a path survives by the light of the record, not by the colour of the surface."""
    found, add = [], cache.Cache.add

    def noted(self, place, half, values):
        found.append(max(np.abs(np.array(value)).max() for value in values))
        add(self, place, half, values)

    monkeypatch.setattr(cache.Cache, "add", noted)
    scene = load(renderer, room_of({"type": "twosided", "bsdf": METAL}, DARK), (64, 36))
    render_stack(scene, 16, 1, "primal", tails="shared")
    assert 1 < max(found) < 10


def test_what_is_left_of_a_material_survives_once(renderer, monkeypatch):
    """Here a tenth is left of all. Where it is followed it weighs as much as the material, and no more."""
    from data_gen.samplers.gpt import base_path

    def little(f, ended):
        answered = dr.max(ended) > 0
        return dr.select(answered, 0.1, 1) * f, dr.select(answered, mi.Float(0.1), 1)

    monkeypatch.setattr(base_path, "rest", little)
    stack = render_stack(load(renderer, room_of(PLASTIC, PLASTIC), (64, 36)), 64, 1, "primal", tails="shared")
    # 7 as it should be, and 320 where it survives twice
    assert 64 * stack["primal_var"].max() < 40


def test_old_records_fade(renderer):
    """Records that are made later count twice as much, but cells with few records keep them."""
    filled, half = cache.Cache(FINENESS), dr.arange(mi.UInt32, N) & 1
    busy, quiet = flat(dr.full(mi.Float, 0.05, N), 0.05), flat(dr.full(mi.Float, 0.95, 2 * LEAST), 0.95)
    filled.unit = 2.0**-20
    filled.add(busy, half, [mi.Float(1)] * 3)
    filled.add(quiet, dr.arange(mi.UInt32, 2 * LEAST) & 1, [mi.Float(1)] * 3)
    filled.fade()
    filled.add(busy, half, [mi.Float(4)] * 3)
    for _ in range(20):
        filled.settle(FINENESS)
        for place, light in ((busy, 3), (quiet, 1)):
            (found, *_), _, known = filled.known.look(place, LEAST, mi.Bool(True))
            assert np.array(known).all() and np.allclose(np.array(found), light, rtol=1e-3)
        filled.fade()


def test_records_of_earlier_rounds_fade(renderer, monkeypatch):
    scene = load(renderer, "diffuse", (32, 24))
    images = [render_stack(scene, 32, 1, "primal", tails="shared")["primal"]]
    monkeypatch.setattr(cache.Cache, "fade", lambda self: None)
    images.append(render_stack(scene, 32, 1, "primal", tails="shared")["primal"])
    assert not np.array_equal(*images) and np.mean(images[0]) == pytest.approx(np.mean(images[1]), rel=0.02)


def test_paths_that_feed_have_random_numbers_of_their_own(renderer, monkeypatch):
    """Otherwise a path of the image would end in the light that the same path has found.

    They go by ``tails_seed``, and so do the borders of cells.
    """
    seeds, grids, grid = {passes: set(), rounds: set()}, set(), rounds.grid
    for module, its in seeds.items():

        def camera(sensor, seed, *args, its=its, real=module.CameraSamples, **named):
            its.add(seed)
            return real(sensor, seed, *args, **named)

        monkeypatch.setattr(module, "CameraSamples", camera)
    monkeypatch.setattr(rounds, "grid", lambda sensor, seed: grids.add(seed) or grid(sensor, seed))
    for seed in (5, 6):
        render_stack(load(renderer, "diffuse", (16, 12)), 16, seed, "primal", tails="shared", tails_seed=5)
    assert len(seeds[passes]) == 2 and len(seeds[rounds]) == 1 and grids == {5}
    assert not set.intersection(*seeds.values())


def test_frames_have_one_cache(renderer, monkeypatch):
    from data_gen.frames import shot

    seeds, render = [], shot.render

    def noted(scene, request, watch, tails_seed):
        seeds.append((request.seed, tails_seed))
        return render(scene, request, watch, tails_seed=tails_seed)

    monkeypatch.setattr(shot, "render", noted)
    list(data_gen.render_frames("diffuse", [0, 1], 1, seed=5, sampler="primal", size=(8, 6)))
    (first, of_tails), (second, again) = seeds
    assert first != second and of_tails == again == 5


def cell_with_a_wall(at, bright, dark, share=1.0, n=4000):
    """A cache whose one cell has other light on either side of a wall, found by a ``share`` of its records."""
    rng = np.random.default_rng(4)
    x = rng.random(n).astype(np.float32)
    light = np.where(x < at, bright, dark) * (rng.random(n) < share) * rng.uniform(0.5, 1.5, n)
    place = CellPlace(mi.Point3f(0.25 * x, 0.1, 0.1), mi.UInt32(0), mi.Int32(-2))
    filled = cache.Cache(FINENESS)
    filled.add(place, dr.arange(mi.UInt32, n) & 1, [mi.Float(light.astype(np.float32))] * 3)
    filled.settle(FINENESS)
    # Both halves say so, or neither
    return int(dr.count(filled.torn(FINENESS))[0]) == 2


@pytest.mark.parametrize("at", [0.3, 0.5, 0.7])
def test_cells_with_a_wall_are_torn(renderer, at):
    assert cell_with_a_wall(at, 1.0, 0.01) and cell_with_a_wall(at, 0.01, 1.0)


def test_other_cells_are_whole(renderer):
    """Light that changes a little, and light that few records have found, whose parts differ by chance."""
    assert not cell_with_a_wall(0.5, 1.0, 0.85)
    assert not any(cell_with_a_wall(0.5, 1.0, 1.0, share=0.01, n=n) for n in (60, 200, 600, 2000))


def test_a_full_cache_says_so_and_goes_on(renderer, caplog, monkeypatch):
    monkeypatch.setattr(cache, "CELLS", 1 << 10)
    stack = render_stack(load(renderer, "diffuse", (32, 24)), 8, 1, "primal", tails="shared")
    assert np.isfinite(stack["primal"]).all()
    (line,) = [line for line in caplog.messages if "cache" in line]
    assert "the light cache is full" in line and "--unbiased" in line


def layers_of(scene, tails, spp):
    """Layers of eight images by ``gpt``."""
    scene = load(mi, scene, (32, 24))
    return [stack.layers for stack in stacks_of(scene, "gpt", 8, spp, tails=tails)]


@pytest.fixture(scope="module")
def shared(renderer):
    return lru_cache(partial(layers_of, tails="shared", spp=32))


# A room without mirrors shows nothing that the others do not. In the ball of glass nothing but caustics is new.
ROOMS = [*(pytest.param(scene, marks=pytest.mark.slow) for scene in ("diffuse", bulb)), "glossy", mirrors, nested]


@pytest.mark.parametrize("scene", ROOMS)
def test_differences_are_those_of_the_image(shared, scene):
    """In means over blocks, within four standard errors. A little more is allowed where only one of two paths ends."""
    stacks = shared(scene)
    assert all(np.isfinite(stack["primal"]).all() for stack in stacks)
    lights = np.array([light_of_gradients(stack) for stack in stacks], np.float64)
    for axis, layer in enumerate(("dx", "dy")):
        ours = np.array([stack[layer] for stack in stacks])
        theirs = np.array([forward_differences(light)[axis] for light in lights])
        each = np.nan_to_num(ours - theirs)[:, :16, :24].reshape(8, 2, 8, 3, 8, 3).mean(axis=(2, 4))
        doubt = each.std(axis=0, ddof=1) / np.sqrt(len(each))
        assert (np.abs(each.mean(axis=0)) < 4 * doubt + 2e-3 * lights.mean()).all(), layer


def light_and_caustics(stacks):
    """The means of both, of each image: (images, 2)."""
    parts = [(stack["primal"] - stack["direct"], stack.get("caustic", np.zeros(1))) for stack in stacks]
    return np.array([[np.mean(part, dtype=np.float64) for part in each] for each in parts])


@pytest.mark.parametrize("scene", ROOMS)
def test_no_light_is_lost_or_counted_twice(shared, scene):
    """Also not light that comes through glass or off a mirror, which ``gpt`` keeps in a layer of its own."""
    ours = light_and_caustics(shared(scene))
    whole = rendered_once(
        scene, (32, 24), "light, caustics", lambda: light_and_caustics(layers_of(scene, "paths", 128))
    )
    doubt = np.sqrt((ours.var(axis=0, ddof=1) + whole.var(axis=0, ddof=1)) / len(ours))
    ours, whole = ours.mean(axis=0), whole.mean(axis=0)
    assert (ours[1] > 0) == (scene not in ("diffuse", nested))
    assert (np.abs(ours - whole) <= 3.5 * doubt + [0.01 * whole[0], 0]).all()


def test_where_nothing_is_diffuse_paths_go_on(renderer):
    """To the bit, and the header says so."""
    metal = builtin.diffuse()
    for part in metal.values():
        if "bsdf" in part:
            part["bsdf"] = ROUGH
    scene = load(renderer, metal, (16, 12))
    shared, paths = (render_stack(scene, 8, 1, "gpt", tails=tails) for tails in ("shared", "paths"))
    assert "ngpt:samplerOptions" not in shared.attributes
    assert all(np.array_equal(shared[layer], paths[layer], equal_nan=True) for layer in shared.names)


PLUGINS = {"open": {"max_depth": 8}, "whole": {"max_depth": 8, "tails": "paths"}}


def test_who_shares(renderer, monkeypatch, tmp_path):
    """Renders that are large enough, by whichever door, and none that is to be unbiased."""
    monkeypatch.setattr(schedule, "BEGIN", 1 << 11)
    scene = load(renderer, "diffuse", (32, 24))
    plugins = {how: renderer.load_dict({"type": "gpt", **how_of}) for how, how_of in PLUGINS.items()}
    images = {how: np.array(plugin.render(scene, spp=8))[..., :3] for how, plugin in plugins.items()}
    assert {how: plugin.options["tails"] for how, plugin in plugins.items()} == {"open": "shared", "whole": "paths"}
    for how, unbiased in (("open", False), ("whole", True)):
        assert np.array_equal(images[how], render_stack(scene, 8, 0, "gpt", unbiased=unbiased)["primal"])
    how = {
        "by default": data_gen.render_scene(scene, 8, sampler="primal").stack,
        "unbiased": data_gen.render_scene(scene, 8, sampler="primal", unbiased=True).stack,
        "few paths": data_gen.render_scene(scene, 2, sampler="primal").stack,
        "little memory": data_gen.render_scene(scene, 8, sampler="primal", memory=256).stack,
        "of programs": render_stack(scene, 8, 0, "primal"),
    }
    shared = {name for name, stack in how.items() if stack.attributes.get("ngpt:samplerOptions") == "tails=shared"}
    assert shared == {"by default", "of programs"}
    assert "shared" in how["by default"] and "shared" not in how["few paths"]
    said = {name: stack.attributes.get("ngpt:tails") for name, stack in how.items()}
    assert said["by default"] == "on" and said["unbiased"] is None
    assert said["few paths"] == "off: there are few paths" and "--memory" in said["little memory"]
    same = [how[name]["primal"] for name in ("by default", "of programs")]
    assert np.array_equal(*same)
    ngpt.write(tmp_path / "shared.exr", how["by default"])
    assert ngpt.read(tmp_path / "shared.exr").attributes["ngpt:samplerOptions"] == "tails=shared"


def test_the_cache_depends_only_on_the_number_of_paths(renderer):
    """Whatever ends a render, and whatever its size: rounds double from some ten thousand paths on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "BEGIN", 1 << 14)
        patch.setattr(schedule, "FIRST", 1 << 16)
        ends = {}
        for pixels in (96 * 54, 320 * 180, 640 * 360, 3840 * 2160):
            sample, ends[pixels] = schedule.first_sample(pixels), []
            for _ in range(4):
                sample = schedule.end_of_round(sample, pixels)
                ends[pixels].append(sample)
        assert [schedule.first_sample(pixels) for pixels in ends] == [4, 0, 0, 0]
        assert list(ends.values()) == [[16, 32, 64, 128], [2, 4, 8, 16], [1, 2, 4, 8], [1, 2, 4, 8]]


def test_known_samples_and_unknown_have_the_same_bits(renderer):
    """A render that time may end, and what it is repeated by."""
    scene = load(renderer, "diffuse", (32, 24))
    timed = render_stack(scene, 40, 3, "primal", seconds=1e4, tails="shared")
    again = render_stack(scene, 40, 3, "primal", points="rounds", tails="shared")
    assert timed.attributes["ngpt:tails"] == "on"
    assert all(np.array_equal(timed[layer], again[layer], equal_nan=True) for layer in timed.names)


def test_light_below_zero_is_light(renderer):
    """Low suns have negative blue."""
    scene = builtin.diffuse()
    for part in scene.values():
        if isinstance(part, dict) and "emitter" in part:
            part["emitter"]["radiance"] = {"type": "rgb", "value": [4.0, 2.0, -1.0]}
    scene = load(renderer, scene, (32, 24))
    light = {tails: render_stack(scene, 64, 1, "primal", tails=tails) for tails in ("shared", "paths")}
    shared, whole = (np.mean(s["primal"] - s["direct"], axis=(0, 1), dtype=np.float64) for s in light.values())
    assert whole[2] < 0 and shared == pytest.approx(whole, rel=0.02)


@pytest.fixture(scope="module")
def rare(renderer):
    """Layers of 32 images of a room lit through a gap: each (32, 24, 32, 3)."""
    scene = load(renderer, slit, (32, 24))
    stacks = stacks_of(scene, "primal", 32, 32, tails="shared")
    return {name: np.array([s[name] for s in stacks], np.float64) for name in ("primal", "shared", "primal_var")}


def test_claims_hold_for_pixels_blocks_and_images(rare):
    """Real over claimed variance. 32 seeds know the ratio of blocks within a fifth."""
    (primal, shared, variance), size = rare.values(), 8
    own = np.maximum(variance - np.array([shared_variance(each) for each in shared]), 0)

    def ratio(side):
        def blocks(image):
            return image.reshape(len(image), 24 // side, side, 32 // side, side, 3).mean(axis=(2, 4))

        claimed = (np.square(blocks(shared)) + blocks(own) / side**2).mean(axis=0)
        return blocks(primal).var(axis=0, ddof=1).sum() / claimed.sum()

    assert 0.8 < ratio(1) < 1.25 and 0.6 < ratio(size) < 1.7
    # Without what pixels share, blocks claim far too little.
    means = primal.mean(axis=(1, 2)).var(axis=0, ddof=1).sum()
    claimed = (np.square(shared.mean(axis=(1, 2))).mean(axis=0) + own.mean(axis=(0, 1, 2)) / (32 * 24)).sum()
    assert 0.4 < means / claimed < 2.3


def test_rare_light_is_found_no_worse(rare):
    """Squared errors of blocks, in the mean and in the worst of the images. Whole paths have 0.0148 and 0.038."""
    errors = np.square(blocks(rare["primal"]) - whole_paths(slit).mean(axis=0)).mean(axis=(1, 2, 3))
    assert errors.mean() < 0.0148 and errors.max() < 0.038


def test_what_cannot_share_says_why(renderer):
    scene = load(renderer, "diffuse", (16, 12))
    with pytest.raises(WrongUse, match="reuse needs whole paths"):
        render_stack(scene, 4, 0, "gpt", tails="shared", reuse=True)
    with pytest.raises((NgptError, RuntimeError), match="tails=shared"):
        renderer.load_dict({"type": "gpt", "tails": "shared", "reuse": True}).render(scene, spp=4)
    # Without the option ``tails`` such renders do not share.
    stack = render_stack(scene, 8, 0, "gpt", unbiased=False, reuse=True)
    assert "tails" not in stack.attributes.get("ngpt:samplerOptions", "")


def test_samples_that_are_shared_out(renderer, caplog):
    caplog.set_level(logging.WARNING, "ngpt")
    scene = load(renderer, "diffuse", (24, 16))
    one, other = (
        render_stack(scene, 64, 3, "gpt", adaptive=Adaptive(None, "wcv"), memory=memory, tails="shared")
        for memory in (6144, 64)
    )
    assert all(np.array_equal(one[layer], other[layer], equal_nan=True) for layer in one.names) and not caplog.messages


@pytest.mark.parametrize(("scene", "most"), [("diffuse", 0.8), pytest.param("haze", 0.7, marks=pytest.mark.slow)])
def test_fewer_rays_find_more(renderer, scene, most):
    """Variance of the image at equal samples, in a room without mirrors and in fog. Measured in fog: .5."""
    scene, noise = load(renderer, scene, (48, 32)), {}
    for tails in ("paths", "shared"):
        images = np.array([stack["primal"] for stack in stacks_of(scene, "primal", 4, 16, tails=tails)])
        noise[tails] = np.median(images.var(axis=0, ddof=1).mean(axis=-1))
    assert noise["shared"] < most * noise["paths"]
