"""What is particular to ``gbdpt``: copies of paths and the weights of pairs, by brute force in float64; roulette."""

from dataclasses import replace

import numpy as np
import pytest
from bdpt_scenes import SCENES
from path_copies import (
    Copies,
    check_copies_to_the_camera,
    check_going_straight_and_back,
    compare_copies,
    corner,
    plan_of,
)
from renders import dr, mi
from unbiased import FAR, load, render_ours

from data_gen.film.splats import Splats
from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Sight
from data_gen.paths.light_ends import LightEnds
from data_gen.samplers import SAMPLERS
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.light_path import Seen, light_path
from data_gen.samplers.bdpt.strategies import to_camera
from data_gen.samplers.bdpt.vertex import cosine
from ngpt_studies.gbdpt.same_light import seen_from_elsewhere


@pytest.fixture
def long_passes(monkeypatch):
    """A pass of 64 samples per pixel: much less of the time goes by with recording kernels."""
    monkeypatch.setitem(SAMPLERS, "gbdpt", replace(SAMPLERS["gbdpt"], batch=64))


def test_lights_seen_from_elsewhere_are_the_same_lights(renderer):
    """Mitsuba 3.9 forgets the emitter of a direction sample that is copied: then all weights are of the first one."""
    scene = load(renderer, SCENES["points"], (16, 16))
    lights, camera = LightEnds(scene), CameraSamples(scene.sensors()[0], 0, 16)
    x, y = (scene.ray_intersect(mi.Ray3f(camera.rays(shift)[0])) for shift in ((0, 0), (3, 2)))
    both, u = x.is_valid() & y.is_valid(), camera.random.clone().next_2d()
    light, weight = scene.sample_emitter_direction(x, u, False, both)
    expected, expected_weight = scene.sample_emitter_direction(y, u, False, both)
    ours, ours_weight, r = seen_from_elsewhere(lights, scene, light, weight, y, both, front=None)
    both = np.array(both & (light.pdf > 0))
    index = np.array(lights.index_of(light.emitter))
    assert set(index[both]) == {0, 1, 2}
    assert np.array_equal(np.array(lights.index_of(ours.emitter))[both], index[both])
    assert np.allclose(np.array(ours.p)[:, both], np.array(expected.p)[:, both], atol=1e-5)
    assert np.allclose(np.array(ours_weight)[:, both], np.array(expected_weight)[:, both], rtol=1e-4)
    assert np.array(r).ravel().tolist() == [1]


# ------------------------- Copies -------------------------


@pytest.fixture(scope="module")
def copies(renderer):
    return Copies(load(renderer, corner, (24, 24)), (3, 2))


@pytest.mark.parametrize("t", [1, 2, 3, 4])
def test_copies_of_paths_to_a_light(copies, t):
    """The fourth vertex is one step behind what both have in common: an error of that step shows there alone."""
    from ngpt_studies.gbdpt.offset_path import to_same_light

    step, offset, own, good = copies.steps[t - 1], copies.offsets[t - 1], copies.copied[t - 1], copies.straight(t)
    good &= step.connectable
    if t < 3:
        good &= copies.materials.connectable(own.bsdf)
        C, r, others = to_same_light(copies.plan, step, offset, own.si, own.bsdf, good)
        r *= offset.r
    else:  # settled
        cos = cosine(step.z.si, step.light.d)
        others = mis.others_to_light(offset.end, step.e_light, step.light.pdf, cos, step.p_light, step.q_light)
        C, r = offset.β * step.f_light * step.weight, offset.r
    lamp = step.light.p, step.light.n
    compare_copies(step.C_light, (C, r, others), copies.brute(t, 0, lamp), copies.copy.brute(t, 0, lamp), 1, good)


@pytest.mark.parametrize(("t", "s"), [(1, 1), (2, 1), (3, 1), (4, 1), (1, 2), (2, 2), (3, 2)])
def test_copies_of_paths_joined_to_light_paths(copies, t, s):
    compare_copies(*copies.joined(t, s))


@pytest.mark.parametrize("s", [1, 2, 3])
def test_copies_of_light_paths_to_the_camera_and_back(copies, s):
    check_copies_to_the_camera(copies, s)


def test_going_straight_to_a_vertex_and_back(copies):
    check_going_straight_and_back(copies)


def test_there_is_no_way_to_what_is_too_smooth_nor_back(renderer):
    """To the ball: copies there would have no copies."""
    copies = Copies(load(renderer, corner, (24, 24)), (3, 2), roughness=0.31)
    check_going_straight_and_back(copies)
    check_copies_to_the_camera(copies, 1)


# ------------------------- Roulette -------------------------


@pytest.mark.slow
def test_roulette_leaves_differences_as_they_are(renderer, long_passes, monkeypatch):
    """Few shifts survive, of the same paths as without a roulette: so all the noise comes from the roulette."""
    from ngpt_studies.gbdpt import integrator, roulette

    scene = load(renderer, "diffuse", (16, 16))

    def gradients():
        stacks = render_ours(scene, "gbdpt", 6, 64, FAR)
        return np.stack([np.stack([stack["dx"], stack["dy"]]) for stack in stacks]).astype(np.float64)

    monkeypatch.setattr(roulette, "SHARE", 0.4)
    with_it = gradients()
    all_survive = lambda camera, rater, lane, depth, threshold: (lane, depth, renderer.Float(1))  # noqa: E731
    monkeypatch.setattr(integrator, "survivors", all_survive)
    without = gradients()
    # For each seed the share of the differences that is missing; its mean is 0.
    mean = without.mean(axis=0)
    lost = ((with_it - without) * mean).sum(axis=(1, 2, 3, 4)) / (mean**2).sum()
    z = lost.mean() / (lost.std(ddof=1) / np.sqrt(len(lost)))
    # Student's t, 5 degrees of freedom: p = 0.001. Survivors that are counted once lose 2 % and more.
    assert 0 < np.abs(lost).max() < 0.1 and abs(z) < 6.9 and abs(lost.mean()) < 0.02, lost


def test_who_survives(renderer):
    """By 1 / p, as ``roulette`` has it, and by numbers of their own for each vertex and seed."""
    from ngpt_studies.gbdpt.roulette import LEAST, RATED, SHARE, Worth, survivors

    sensor = load(renderer, "diffuse", (32, 32)).sensors()[0]
    n, places = 32 * 32 * 8, np.random.default_rng(5)
    light = places.exponential(1, n * RATED).astype(np.float32)
    pixel = places.integers(0, 32 * 32, n * RATED).astype(np.uint32)
    threshold = places.exponential(4, 32 * 32).astype(np.float32)
    threshold[:64] = 0
    worth = Worth(mi.Float(light), mi.UInt32(pixel), dr.opaque(mi.UInt32, n))
    lane = np.tile(np.arange(n, dtype=np.uint32), RATED + 1)
    depth = np.repeat(np.arange(1, RATED + 2, dtype=np.uint32), n)
    with np.errstate(divide="ignore"):
        p = np.clip(SHARE * light / threshold[pixel], LEAST, 1)
    p = np.concatenate([p, np.ones(n)])  # the vertices behind those that are rated
    found = []
    for seed in range(2):
        camera = CameraSamples(sensor, seed, 8)
        lanes, depths, times = survivors(camera, worth, mi.UInt32(lane), mi.UInt32(depth), mi.Float(threshold))
        place = (np.array(depths) - 1) * n + np.array(lanes)
        assert np.allclose(np.array(times), 1 / p[place], rtol=1e-5)
        kept = np.zeros(len(p))
        kept[place] = 1
        found.append(kept)
        for some in (p < 1, p < 1.01 * LEAST, depth == 1, depth == RATED, np.arange(len(p)) % 2 == 0):
            z = (kept - p)[some].sum() / np.sqrt((p * (1 - p))[some].sum())
            assert abs(z) < 4.5, z
        assert kept[p == 1].all()
    # Two seeds and two depths are independent.
    rest = (np.array(found) - p) / np.sqrt(np.maximum(p * (1 - p), 1e-9))
    pairs = [rest[0] * rest[1], rest[0][:n] * rest[0][n : 2 * n]]
    for product in pairs:
        assert abs(product.sum()) < 4.5 * np.sqrt((product**2).sum())


@pytest.mark.parametrize("name", ["lens", pytest.param("glossy", marks=pytest.mark.slow)])
def test_what_the_camera_has_seen_is_found_again(renderer, name):
    """The second kernel splats what the first one has splatted, and never a vertex that was not seen."""
    from ngpt_studies.gbdpt.light_again import Marker, light_again, marked

    scene = load(renderer, name, (32, 24))
    camera, longest = CameraSamples(scene.sensors()[0], 5, 64), 7
    plan, sight = plan_of(scene, longest), Sight.of(camera)
    plan.limits.rr_depth = 3
    first, second = Splats(camera.pixels, 3), Splats(camera.pixels, 3)
    *_, state = light_path(plan, sight, Marker(first, sight.ray, sight.importance))
    lanes, depths = marked(state, longest)
    assert set(np.array(depths)) == set(range(1, longest)) and np.all(np.diff(np.array(depths).astype(int)) >= 0)
    some = Sight.of(camera.at(lanes))
    again = light_again(plan, some, depths)
    end, link, left, there = again.end, again.link, again.left, again.there
    C, others, uv = to_camera(some.eye, again.lens, end.y, end.y.si.bsdf(), there, lambda *_: 1)
    marker = Marker(second, some.ray, some.importance)
    marker.sees(mi.UInt64(0), Seen(end.y, C, others, some.eye.pixel_at(uv), None))
    smooth = link.depth + 1 == end.y.depth
    before = dr.select(link.depth > 0, left.o + left.d * left.t, end.ray.o)
    beside = dr.select(smooth & (link.depth > 0), dr.norm(mi.Vector3f(before - end.ray.o)), 0)
    found, theirs = (np.array(splats.totals()) for splats in (first, second))
    assert np.array(there & (dr.max(C) > 0)).mean() > 0.999
    assert np.allclose(found.sum(axis=1), theirs.sum(axis=1), rtol=1e-3)
    assert np.isclose(found, theirs, rtol=1e-3, atol=1e-6).mean() > 0.99
    # What is kept of the vertex before is where the last edge begins.
    assert np.quantile(np.array(beside), 0.99) < 1e-3
