"""Paths that end in a cache: which vertices may, that no bit depends on passes, and that differences are the image's.

How large the bias is where light may leak is in ``test_tails_leaks``.
"""

import logging

import numpy as np
import pytest
from tails_scenes import bulb, mirrors
from unbiased import light_of_gradients, load

import ngpt
from ngpt.errors import NgptError, WrongUse

DIFFUSE = {"type": "diffuse"}
ROUGH = {"type": "roughconductor", "alpha": 0.4}
# Materials, and whether a path may end there
MATERIALS = {
    "diffuse": (DIFFUSE, True),
    "two-sided": ({"type": "twosided", "material": DIFFUSE}, True),
    "bumpy": ({"type": "bumpmap", "bumps": {"type": "checkerboard"}, "material": DIFFUSE}, True),
    "rough plastic": ({"type": "roughplastic", "alpha": 0.3}, True),
    "polished plastic": ({"type": "roughplastic", "alpha": 0.1}, False),
    "plastic": ({"type": "plastic"}, False),
    "metal": ({"type": "conductor"}, False),
    "rough metal": (ROUGH, False),
    "glass": ({"type": "dielectric"}, False),
    "rough glass": ({"type": "roughdielectric", "alpha": 0.5}, False),
    "pane": ({"type": "thindielectric"}, False),
    "principled": ({"type": "principled", "roughness": 0.7}, True),
    "polished": ({"type": "principled", "roughness": 0.2}, False),
    "metallic": ({"type": "principled", "roughness": 0.7, "metallic": 0.8}, False),
    "translucent": ({"type": "principled", "roughness": 0.7, "spec_trans": 0.5}, False),
    "leaf": ({"type": "principledthin", "roughness": 0.7}, False),
    "mask": ({"type": "mask", "opacity": 0.5, "material": DIFFUSE}, False),
    "blend": ({"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": {"type": "roughplastic", "alpha": 0.3}}, True),
    "blend with metal": ({"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": {"type": "conductor"}}, False),
    "hole": ({"type": "null"}, False),
    "hair": ({"type": "hair"}, False),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_paths_end_at_matt_materials_alone(renderer, name):
    from data_gen.tails.matt import is_matt

    material, matt = MATERIALS[name]
    assert is_matt(renderer.load_dict(material)) == matt


def records(mi, n, rng):
    from data_gen.tails.cells import Place

    p = [mi.Float(rng.random(n).astype(np.float32)) for _ in range(3)]
    place = Place(mi.Point3f(*p), mi.UInt32(rng.integers(0, 4, n)), mi.Int32(rng.integers(-4, -2, n)))
    return place, [mi.Float(rng.exponential(1, n).astype(np.float32)) for _ in range(3)]


def some(mi, place, value, which):
    import drjit as dr

    from data_gen.tails.cells import Place

    which = mi.UInt32(which)
    dr.eval(which)
    p, code, level, *light = (dr.gather(type(v), v, which) for v in (place.p, place.code, place.level, *value))
    return Place(p, code, level), light


def test_what_is_known_depends_on_no_order(renderer):
    """The sums are integers, and each cell judges those within it whatever came first."""
    import drjit as dr

    from data_gen.tails.cache import Cache

    mi, rng = renderer, np.random.default_rng(3)
    place, value = records(mi, 20_000, rng)
    order = rng.permutation(20_000)
    found = []
    for parts in ([np.arange(20_000)], [order[:7], order[7:5000], order[5000:]]):
        cache = Cache(16.0)
        # The unit of sums is by the first records.
        cache.unit = 2.0**-26
        for which in parts:
            cache.add(*some(mi, place, value, which))
        cache.settle(16.0)
        (light,), trusted = cache.known.look(place, mi.Bool(True))
        dr.eval(light, trusted)
        found.append((np.array(light), np.array(trusted)))
    assert np.array_equal(found[0][0], found[1][0]) and np.array_equal(found[0][1], found[1][1])
    assert 0.2 < found[0][1].mean() <= 1
    # The means of exponential numbers are near 1.
    assert abs(found[0][0][:, found[0][1]].mean() - 1) < 0.05


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e12])
def test_what_is_known_has_all_the_light(renderer, scale):
    """Also where one record in thousands brings a tenth of it."""
    import drjit as dr

    from data_gen.tails.cache import Cache
    from data_gen.tails.cells import Place

    mi, rng, n = renderer, np.random.default_rng(1), 20_000
    u, v = (mi.Float(rng.random(n).astype(np.float32)) for _ in range(2))
    place = Place(mi.Point3f(u, v, 0.02), mi.UInt32(0), mi.Int32(-3))
    light = scale * dr.select(dr.arange(mi.UInt32, n) == 5, 1e3, mi.Float(rng.random(n).astype(np.float32)))
    cache = Cache(16.0)
    cache.add(place, [light, 0.5 * light, mi.Float(0)])
    cache.settle(16.0)
    (found,), trusted = cache.known.look(place, mi.Bool(True))
    red, green, blue = np.array(found, np.float64)
    assert np.array(trusted).all() and np.allclose(green, 0.5 * red, rtol=1e-4) and not blue.any()
    # At the edges cells have too few records, and those around answer for them.
    assert red.sum() == pytest.approx(np.array(light, np.float64).sum(), rel=1e-3)


def test_one_record_cannot_bring_most_of_the_light(renderer, monkeypatch):
    """It is cut to so many times the mean, or to a part of all light where there are many records."""
    import drjit as dr

    from data_gen.tails import cache
    from data_gen.tails.cells import Place

    mi, n = renderer, 20_000
    place = Place(mi.Point3f(dr.full(mi.Float, 0.5, n), 0.5, 0.02), mi.UInt32(0), mi.Int32(-3))
    values = np.ones(n, np.float32)
    values[5] = 1e6
    mean = values.mean()
    for parts, most in ((200, 3000 * mean), (2, n * mean / 2)):
        monkeypatch.setattr(cache, "PARTS", parts)
        filled = cache.Cache(16.0)
        filled.add(place, [mi.Float(values), mi.Float(0.5 * values), mi.Float(0)])
        filled.settle(16.0)
        (found,), trusted = filled.known.look(place, mi.Bool(True))
        assert trusted[0] and float(found.x[0]) == pytest.approx((n - 1 + most) / n, rel=1e-3)
        assert float(found.y[0]) == pytest.approx(0.5 * float(found.x[0]), rel=1e-3)


def test_a_full_cache_says_so_and_goes_on(renderer, caplog, monkeypatch):
    from data_gen.render import render_stack
    from data_gen.tails import cache

    monkeypatch.setattr(cache, "CELLS", 1 << 10)
    stack = render_stack(load(renderer, "diffuse", (32, 24)), 8, 1, "primal", tails="shared")
    assert np.isfinite(stack["primal"]).all()
    (line,) = [line for line in caplog.messages if "cache" in line]
    assert "the cache of tails is full" in line and "--unbiased" in line


@pytest.mark.parametrize("scene", ["diffuse", "glossy", bulb, mirrors])
def test_differences_are_those_of_the_image(renderer, scene):
    """In the mean over blocks, within four standard errors and a little for places where but one of two paths ends."""
    from data_gen.render import render_stack
    from ngpt.classical.gradients import forward_differences

    scene = load(renderer, scene, (32, 24))
    stacks = [render_stack(scene, 32, seed, "gpt", tails="shared").layers for seed in range(8)]
    assert all(np.isfinite(stack["primal"]).all() for stack in stacks)
    lights = [light_of_gradients(stack).astype(np.float64) for stack in stacks]
    for axis, layer in enumerate(("dx", "dy")):
        each = []
        for stack, light in zip(stacks, lights, strict=True):
            error = np.nan_to_num(stack[layer] - forward_differences(light)[axis])[:16, :24]
            each.append(error.reshape(2, 8, 3, 8, 3).mean(axis=(1, 3)))
        each = np.array(each)
        doubt = each.std(axis=0, ddof=1) / np.sqrt(len(each))
        assert (np.abs(each.mean(axis=0)) < 4 * doubt + 2e-3 * np.mean(lights)).all(), layer


@pytest.mark.parametrize("scene", ["glossy", bulb, mirrors])
@pytest.mark.parametrize("sampler", ["primal", "gpt"])
def test_no_light_is_lost_or_counted_twice(renderer, sampler, scene):
    """Also not light that comes through glass or off a mirror, which ``gpt`` keeps in a layer of its own."""
    from data_gen.render import render_stack

    scene, mean, late = load(renderer, scene, (48, 32)), {}, {}
    for tails in ("paths", "shared"):
        stacks = [render_stack(scene, 64, seed, sampler, tails=tails).layers for seed in range(4)]
        mean[tails] = np.mean([stack["primal"] - stack["direct"] for stack in stacks], dtype=np.float64)
        late[tails] = np.mean([stack.get("caustic", 0) for stack in stacks], dtype=np.float64)
    assert mean["shared"] == pytest.approx(mean["paths"], rel=0.02)
    assert late["shared"] == pytest.approx(late["paths"], rel=0.02)
    assert (late["paths"] > 0) == (sampler == "gpt")


def test_where_nothing_is_matt_paths_go_on(renderer):
    """To the bit, and the header says so."""
    from data_gen.render import render_stack
    from data_gen.scenes import builtin

    def metal():
        parts = builtin.diffuse()
        return {
            k: part | {"bsdf": ROUGH} if isinstance(part, dict) and "bsdf" in part else part
            for k, part in parts.items()
        }

    scene = load(renderer, metal, (16, 12))
    shared, paths = (render_stack(scene, 8, 1, "gpt", tails=tails) for tails in ("shared", "paths"))
    assert "ngpt:samplerOptions" not in shared.attributes
    assert all(np.array_equal(shared[layer], paths[layer], equal_nan=True) for layer in shared.names)


def test_who_shares(renderer, tmp_path):
    """Renders that users ask for, if they are large enough; no others, and none that is to be unbiased."""
    import data_gen
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (96, 88))
    how = {
        "by default": data_gen.render_scene(scene, 8, sampler="primal").stack,
        "unbiased": data_gen.render_scene(scene, 8, sampler="primal", unbiased=True).stack,
        "few paths": data_gen.render_scene(scene, 2, sampler="primal").stack,
        "little memory": data_gen.render_scene(scene, 8, sampler="primal", memory=256).stack,
        "of programs": render_stack(scene, 8, 0, "primal"),
    }
    shared = {name for name, stack in how.items() if stack.attributes.get("ngpt:samplerOptions") == "tails=shared"}
    assert shared == {"by default"}
    assert np.array_equal(how["unbiased"]["primal"], how["of programs"]["primal"])
    ngpt.write(tmp_path / "shared.exr", how["by default"])
    assert ngpt.read(tmp_path / "shared.exr").attributes["ngpt:samplerOptions"] == "tails=shared"


@pytest.mark.parametrize(
    ("scene", "options", "reason"),
    [
        ("haze", {}, "the integrator is 'volpath'"),
        ("diffuse", {"reuse": True}, "reuse needs whole paths"),
        ("diffuse", {"shift": "manifold"}, "shift=manifold needs whole paths"),
    ],
)
def test_what_cannot_share_says_why(renderer, scene, options, reason):
    from data_gen.render import render_stack

    with pytest.raises(WrongUse, match=reason):
        render_stack(load(renderer, scene, (8, 8)), 4, 0, "gpt", tails="shared", **options)
    # Where nobody asks for it in so many words, such renders are as before.
    stack = render_stack(load(renderer, scene, (96, 88)), 8, 0, "gpt", unbiased=False, **options)
    assert "tails" not in stack.attributes.get("ngpt:samplerOptions", "")


def test_the_plugin_refuses_what_it_cannot(renderer):
    with pytest.raises((NgptError, RuntimeError), match="tails=shared"):
        integrator = renderer.load_dict({"type": "gpt", "tails": "shared", "reuse": True})
        integrator.render(load(renderer, "diffuse", (8, 8)), spp=4)


def test_kernels_are_recorded_once(renderer, recordings):
    from data_gen.render import render_stack

    render_stack(load(renderer, "glossy", (24, 16)), 40, 3, "gpt", tails="shared")
    # The cache's arrays are replaced between rounds, and have their widths.
    assert set(recordings.of) == {"samples", "paths"} and recordings.total() <= 4


def test_samples_that_are_shared_out(renderer, caplog):
    from data_gen.adaptive import Adaptive
    from data_gen.render import render_stack

    caplog.set_level(logging.WARNING, "ngpt")
    scene = load(renderer, "diffuse", (24, 16))
    one, other = (
        render_stack(scene, 64, 3, "gpt", adaptive=Adaptive(None, "wcv"), memory=memory, tails="shared")
        for memory in (6144, 64)
    )
    assert all(np.array_equal(one[layer], other[layer], equal_nan=True) for layer in one.names) and not caplog.messages


def test_fewer_rays_find_more(renderer):
    """Variance of the image at equal samples, in a room without mirrors."""
    from data_gen.render import render_stack

    scene = load(renderer, "diffuse", (48, 32))
    noise = {}
    for tails in ("paths", "shared"):
        images = np.array([render_stack(scene, 16, seed, "primal", tails=tails)["primal"] for seed in range(4)])
        noise[tails] = np.median(images.var(axis=0, ddof=1).mean(axis=-1))
    assert noise["shared"] < 0.8 * noise["paths"]
