"""Lamps by place: probabilities, shifts that keep their lamp, and images whose means are Mitsuba's.

Most tests take tables of any probabilities, far from each other in cells side by side: what a pilot learns is smooth,
and hides what is wrong.
"""

from dataclasses import replace

import numpy as np
import pytest
from lamps_scenes import GALLERIES, gallery
from references import references
from renders import dr, mi
from unbiased import FAR, assert_unbiased, load, render_ours

from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.lights import Lights, emission, emission_in_pixel, replay_lamp, shared_emission
from data_gen.paths.vertex import seen_from
from data_gen.scenes.lamps import LampTable, Places, weighed

LANES = 1 << 14


def any_places(scene, side=4, seed=1):
    """A table of probabilities that have nothing to do with the scene."""
    lamps = len(scene.emitters())
    table = np.random.default_rng(seed).dirichlet(np.full(lamps, 0.5), side**3 + 1)
    low, high = np.array([-2.5, -0.1, -2.5]), np.array([2.5, 2.5, 2.5])
    return Places(scene, LampTable(0.8 * table + 0.2 / lamps, low, (high - low) / side, side))


@pytest.fixture
def by_any_places(monkeypatch):
    """Renders choose lamps by such a table, with however few lamps."""
    from data_gen.scenes import lamps

    monkeypatch.setattr(lamps, "lamp_places", lambda scene, weights, found: any_places(scene))
    monkeypatch.setattr(lamps, "MANY", 2)


def vertices(mi, seed):
    """Points in the gallery, with normals."""
    random = mi.PCG32(LANES, seed)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.p = mi.Point3f(5 * random.next_float32() - 2.5, 2 * random.next_float32(), 5 * random.next_float32() - 2.5)
    si.n, si.t = mi.Normal3f(0, 0, 1), mi.Float(1)
    return si, mi.Point2f(random.next_float32(), random.next_float32())


def test_probabilities_are_those_of_the_choice(renderer):
    mi, scene = renderer, load(renderer, gallery, (4, 4))
    places, lamps = any_places(scene), len(scene.emitters())
    x, u = vertices(mi, 3)
    chosen = places.choose(x, u)
    left = np.array(chosen.u)[0]
    assert np.array(chosen.lamp).max() == lamps - 1
    assert np.array_equal(np.array(chosen.p), np.array(places.probability(x, chosen.lamp)))
    assert left.min() >= 0 and left.max() < 1 and abs(left.mean() - 0.5) < 0.02
    # In each cell: the sum over lamps, and how often each is chosen where numbers are even.
    total = sum(places.probability(x, mi.UInt32(number)) for number in range(lamps))
    assert np.allclose(np.array(total), 1, atol=1e-5)
    one = dr.zeros(mi.SurfaceInteraction3f, LANES)

    def shares():
        return [float(places.probability(one, mi.UInt32(number))[0]) for number in range(lamps)]

    one.p, one.t = mi.Point3f(0.3, 1, -0.2), mi.Float(1)
    even = mi.Point2f((dr.arange(mi.Float, LANES) + 0.5) / LANES, 0.5)
    counts = np.bincount(np.array(places.choose(one, even).lamp), minlength=lamps)
    assert np.allclose(counts / LANES, shares(), atol=2 / LANES)
    # What is nowhere has the last row, wherever it says it is.
    one.p, one.t = mi.Point3f(np.nan), mi.Float(np.inf)
    assert np.allclose(shares(), np.array(places.p)[-lamps:])


def test_no_lamp_is_out_of_the_question(renderer):
    """Not even one that the pilot sees nothing of; each place has its own."""
    from data_gen.scenes import lamps

    description = gallery(low=True)
    hidden = {"type": "rectangle", "emitter": {"type": "area"}}
    hidden["to_world"] = renderer.ScalarTransform4f().translate([0, -3, 0]).rotate([1, 0, 0], 90)
    scene = load(renderer, lambda: description | {"hidden": hidden}, (16, 16))
    with weighed(scene, "power", by_place=True) as places:
        table = np.array(places.p).reshape(-1, len(scene.emitters()))
    assert len(scene.emitters()) >= lamps.MANY
    assert np.allclose(table.sum(axis=1), 1, atol=1e-5)
    assert table.min() > 0.01 / len(scene.emitters())
    assert (table.max(axis=0) > 3 * table.min(axis=0)).sum() > 10


def test_taken_for_many_lamps_that_the_scene_leaves_open(renderer):
    def places_of(change=None, lamps="power", by_place=True):
        description = gallery(low=True)
        if change:
            change(description)
        with weighed(load(renderer, lambda: description, (8, 8)), lamps, by_place) as places:
            return places

    assert places_of()
    assert not places_of(lamps="uniform")
    assert not places_of(by_place=False)
    assert not places_of(lambda scene: scene["lamp_3"]["emitter"].update(sampling_weight=0.0))
    assert not places_of(lambda scene: scene.update(gallery()))  # each lights up all of it
    assert not places_of(lambda scene: [scene.pop(f"lamp_{number}") for number in range(9)])


def test_one_pilot_serves_both_and_its_vertices_are_a_loop(renderer, monkeypatch):
    """With thousands of lamps each vertex that is recorded takes seconds."""
    from data_gen.scenes import lamps

    scene, drawn, pair = load(renderer, lambda: gallery(low=True), (8, 8)), [], lamps._pair
    small = lamps._pilot(scene, 1 << 10)
    monkeypatch.setattr(lamps, "_pair", lambda random: (drawn.append(1), pair(random))[1])
    monkeypatch.setattr(lamps, "_PATHS_BY_PLACE", 1 << 12)
    monkeypatch.setattr(lamps, "_PATHS", 1 << 10)
    first = lamps._pilot(scene, 1 << 12).first(1 << 10)
    for name in ("lamp", "L", "at", "path"):
        assert np.array_equal(getattr(first, name), getattr(small, name)), name
    drawn.clear()
    with weighed(scene, "power", by_place=True):
        assert len(drawn) <= 6  # two for the camera, and two for each recording of a vertex: Dr.Jit makes two of a loop


def test_what_a_pixel_sees_of_lamps_is_recorded_once(renderer):
    scene, calls = load(renderer, gallery, (8, 8)), []
    camera = CameraSamples(scene.sensors()[0], 0, 1)
    Le = emission_in_pixel(scene, camera, dr.zeros(renderer.Spectrum, 64), lambda ray: calls.append(1) or ray.d)
    rays = [camera.rays(shift)[0].d for shift in QUARTERS]
    assert len(calls) == 1 and np.allclose(Le, np.array(sum(rays)) / 4, atol=1e-6)


def nearly(one, other, good, most=2e-3):
    """For 99 of 100."""
    return (np.abs(np.array(one / other)[np.array(good)] - 1) < most).mean() > 0.99


@pytest.mark.parametrize("flat", [True, False])
def test_a_shifted_path_keeps_its_lamp(renderer, flat):
    """It has the density of its own end and the weight of the base path's, and r(T(x)) r(x) = 1."""
    scene = load(mi, lambda: gallery(flat), (4, 4))
    places = any_places(scene)
    lights, yes = Lights(scene, places), mi.Bool(True)
    assert lights.shared == flat
    (x, u), (y, _) = vertices(mi, 3), vertices(mi, 5)
    base, weight, chosen = lights.sample(scene, x, u, yes)
    there, r = replay_lamp(lights, base, weight, chosen, x, y, lit=yes)
    chosen = replace(chosen, p=places.probability(y, chosen.lamp))
    own, own_weight = places.sample(y, chosen, yes)
    back, r_back = replay_lamp(lights, own, own_weight, chosen, y, x, lit=yes)
    assert np.allclose(np.array(r * r_back), 1, rtol=1e-5) and np.array(r).std() > 1
    lit = np.array((dr.max(own_weight) > 0) & (own.pdf > 0))
    assert lit.mean() > 0.2
    assert nearly(there.p, own.pdf, lit) and nearly(dr.max(there.weight), dr.max(own_weight) * r, lit)
    assert nearly(back.p, base.pdf, (dr.max(weight) > 0) & (base.pdf > 0))
    # A base path that is nowhere has the weight 1/2 from the other side; but the density is that of the vertex.
    x.t = mi.Float(np.inf)
    base, weight, chosen = lights.sample(scene, x, u, yes)
    there, r = replay_lamp(lights, base, weight, chosen, x, y, lit=yes)
    assert np.array_equal(np.array(r), np.ones(LANES))
    own, _ = places.sample(y, replace(chosen, p=places.probability(y, chosen.lamp)), yes)
    assert nearly(there.p, own.pdf, (there.p > 0) & (own.pdf > 0))


def test_emission_that_is_met_has_the_density_of_the_vertex(renderer):
    mi, scene = renderer, load(renderer, gallery, (4, 4))
    places = any_places(scene)
    lights, yes = Lights(scene, places), mi.Bool(True)
    (x, u), (y, _) = vertices(mi, 3), vertices(mi, 5)
    light, weight, _ = lights.sample(scene, x, u, yes)
    x1 = scene.ray_intersect(x.spawn_ray(light.d))
    Le, p = emission(scene, x1, x, yes, yes, lights)
    met = np.array((x1.emitter(scene) == light.emitter) & (light.pdf > 0) & (dr.max(weight) > 0))
    assert met.mean() > 0.2 and nearly(p, light.pdf, met)
    d = dr.select(x1.is_valid(), dr.normalize(x1.p - y.p), light.d)
    y1, J = seen_from(x1, d), dr.squared_norm(x1.p - y.p) / dr.square(x1.t)
    Le1, p1 = shared_emission(scene, lights, x1, Le, p, x=x, y=y, y1=y1, J=J)
    own, p_own = emission(scene, y1, y, yes, yes, lights)
    lit = np.array(dr.max(own) > 0)
    assert lit.mean() > 0.1 and nearly(p1, p_own, lit, 5e-3)
    assert np.array_equal(np.array(dr.max(Le1) > 0), lit)


def test_the_plugin_takes_it_too(renderer):
    scene = load(renderer, lambda: gallery(low=True), (8, 8))
    plugin = renderer.load_dict({"type": "gpt", "max_depth": 2})
    assert np.isfinite(np.array(renderer.render(scene, integrator=plugin, spp=1))).all()
    assert plugin.places


@pytest.mark.parametrize(
    "name", ["flat", *(pytest.param(name, marks=pytest.mark.slow) for name in list(GALLERIES)[1:])]
)
def test_unbiased(renderer, name, by_any_places):
    """Differences of ``gpt``, and the primal by its base paths alone."""
    scene, expected = load(renderer, GALLERIES[name], (32, 32)), references(renderer, GALLERIES[name], (32, 32))
    assert_unbiased(render_ours(scene, "gpt", 8, 48, FAR), expected, pixels=FAR)
    assert_unbiased(render_ours(scene, "primal", 8, 48, features=False), expected)
