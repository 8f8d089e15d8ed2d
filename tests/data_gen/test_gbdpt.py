"""What is particular to ``gbdpt``: copies of paths and the weights of pairs, by brute force in float64; roulette."""

import numpy as np
import pytest
from bdpt_ends import fresh, plan_of
from bdpt_scenes import SCENES, corner
from unbiased import FAR, load, render_ours


@pytest.fixture
def long_passes(monkeypatch):
    """A pass of 64 samples per pixel: much less of the time goes by with recording kernels."""
    from dataclasses import replace

    from data_gen.samplers import SAMPLERS

    monkeypatch.setitem(SAMPLERS, "gbdpt", replace(SAMPLERS["gbdpt"], batch=64))


def test_lights_seen_from_elsewhere_are_the_same_lights(renderer):
    """Mitsuba 3.9 forgets the emitter of a direction sample that is copied: then all weights are of the first one."""
    from data_gen.paths.camera import CameraSamples
    from data_gen.paths.light_ends import LightEnds

    mi, scene = renderer, load(renderer, SCENES["points"], (16, 16))
    lights, camera = LightEnds(scene), CameraSamples(scene.sensors()[0], 0, 16)
    x, y = (scene.ray_intersect(mi.Ray3f(camera.rays(shift)[0])) for shift in ((0, 0), (3, 2)))
    both, u = x.is_valid() & y.is_valid(), camera.random.clone().next_2d()
    light, weight = scene.sample_emitter_direction(x, u, False, both)
    expected, expected_weight = scene.sample_emitter_direction(y, u, False, both)
    ours, ours_weight, r = lights.seen_from_elsewhere(scene, light, weight, y, both)
    both = np.array(both & (light.pdf > 0))
    index = np.array(lights.index_of(light.emitter))
    assert set(index[both]) == {0, 1, 2}
    assert np.array_equal(np.array(lights.index_of(ours.emitter))[both], index[both])
    assert np.allclose(np.array(ours.p)[:, both], np.array(expected.p)[:, both], atol=1e-5)
    assert np.allclose(np.array(ours_weight)[:, both], np.array(expected_weight)[:, both], rtol=1e-4)
    assert np.array(r).ravel().tolist() == [1]


class Paths:
    """Paths from either end of ``corner`` and the copies of them, and brute-force densities and f in float64.

    One of each for each lane, in evaluated arrays. Offset paths go through pixels 3 to the right and 2 down.
    """

    SHIFT = (3, 2)
    LENGTH = 4

    def __init__(self, mi):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.paths.eye import Eye
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import Vertex, cosine
        from data_gen.samplers.gbdpt.base_path import base_step
        from data_gen.samplers.gbdpt.offset_path import start, take_step

        self.mi, self.dr = mi, dr
        self.scene = scene = load(mi, corner, (24, 24))
        self.camera = camera = CameraSamples(scene.sensors()[0], 1, 64)
        self.sensor, self.lens = camera.sensor, camera.lens
        self.plan = plan = plan_of(scene)
        ray, _, _ = camera.rays()
        self.random = camera.random.clone()
        self.first = plan.lights.sample(scene, self.random, ray.time, ray.wavelengths)
        self.from_light = self.light_path()
        # Steps of the camera path, and its offset path before each
        self.steps, self.offsets = [], []
        x = scene.ray_intersect(mi.Ray3f(ray))
        _, e = self.sensor.sample_direction(x, self.lens)
        offset_ray, importance, inside = camera.rays(self.SHIFT)
        hit = scene.ray_intersect_preliminary(offset_ray)
        offsets = [start(Eye.of(camera), x, (offset_ray, importance, inside), hit)]
        z = Vertex(x, mi.Spectrum(1), mis.begin_camera(e[0], cosine(x, ray.d)), mi.UInt32(1))
        active = x.is_valid()
        for _ in range(self.LENGTH):
            step, _ = base_step(plan, self.random, z, fresh(mi), active, brightest_offset=mi.Float(0))
            self.steps.append(step)
            self.offsets.append(offsets[0])
            offsets = take_step(plan, step, offsets)
            z = Vertex(step.x1, step.β1, step.end1, z.depth + 1)
            active = step.goes_on & step.x1.is_valid()
            dr.eval(step, offsets, z, active)

    def light_path(self):
        """(Vertex, whether it is there, whether it was left smoothly, density with which it was left)"""
        from data_gen.paths.vertex import SMOOTH, event_kind
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import IMPORTANCE, Vertex, context, cosine, light_leaves

        mi, dr, scene, lights = self.mi, self.dr, self.scene, self.plan.lights
        si, β = scene.ray_intersect(self.first.ray), self.first.β
        e, p = lights.densities(scene, self.first, si)
        end, found, there = mis.begin_light(e, p, self.first.delta, cosine(si, self.first.ray.d)), [], si.is_valid()
        d = self.first.ray.d
        for depth in range(1, self.LENGTH + 1):
            vertex, bsdf = Vertex(si, β, end, mi.UInt32(depth)), si.bsdf()
            random = self.random
            sample, f_p = bsdf.sample(context(IMPORTANCE), si, random.next_1d(), random.next_2d(), there)
            found.append((vertex, there, event_kind(sample.sampled_type) == SMOOTH, mi.Float(sample.pdf), d))
            d, f_p, end = light_leaves(vertex, bsdf, sample, f_p, there)
            β = β * f_p
            there = there & (sample.pdf > 0)
            si = scene.ray_intersect(si.spawn_ray(d), there)
            there &= si.is_valid()
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
            dr.eval(found, si, end, there, d)
        return found

    @np.errstate(divide="ignore", invalid="ignore")
    def brute(self, vertices, lamp):
        """Of paths through these interactions to the point of a lamp: the densities p_0 .. p_k of all strategies, f,
        and the density of the first vertex as the film samples it; all per area."""
        mi, dr = self.mi, self.dr
        points = [np.array(self.sensor.world_transform().translation(), np.float64).reshape(1, 3)]
        points += [np.array(v.p, np.float64).T for v in vertices] + [np.array(lamp[0], np.float64).T]
        normals = [None] + [np.array(v.n, np.float64).T for v in vertices] + [np.array(lamp[1], np.float64).T]
        k = len(points) - 1

        def cosine(i, j):
            d = points[j] - points[i]
            return np.abs((normals[i] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)

        def per_area(i, j):
            return cosine(j, i) / ((points[j] - points[i]) ** 2).sum(axis=1)

        def scatter(i, come_from, go_to):
            si = mi.SurfaceInteraction3f(vertices[i - 1])
            wi, wo = (
                si.to_local(dr.normalize(mi.Vector3f(*(points[j] - points[i]).T.astype(np.float32))))
                for j in (come_from, go_to)
            )
            si.wi = wi
            f, p = si.bsdf().eval_pdf(mi.BSDFContext(), si, wo)
            return np.array(f, np.float64).T, np.array(p, np.float64)

        forward = {i: scatter(i, i - 1, i + 1) for i in range(1, k)}
        backward = {i: scatter(i, i + 1, i - 1) for i in range(1, k)}
        _, importance = self.sensor.sample_direction(vertices[0], self.lens)
        first = np.array(importance[0], np.float64) * cosine(1, 0)
        densities = []
        for s in range(k + 1):
            last = k - s
            p = np.ones(len(first))
            if last > 0:
                p = p * first
            for i in range(1, last):
                p = p * forward[i][1] * per_area(i, i + 1)
            if s > 1:
                p = p * cosine(k, k - 1) / np.pi * per_area(k, k - 1)
            for i in range(k - 1, last + 1, -1):
                p = p * backward[i][1] * per_area(i, i - 1)
            densities.append(p)
        f = first[:, None]
        for i in range(1, k):
            f = f * forward[i][0] * per_area(i, i + 1)[:, None]
        return densities, f, first

    def compare(self, C, found, base, copy, s, good):
        """``found`` = (C', r, others') of the copies of bases of contribution C against brute force, and which of them
        were compared."""
        C, shifted, r, others = (np.array(v, np.float64) for v in (C, *found))
        (p, f, first), (p1, f1, first1) = base, copy
        good = np.array(good) & (shifted.max(axis=0) > 0) & (C.max(axis=0) > 0)
        assert good.sum() > 100
        with np.errstate(divide="ignore", invalid="ignore"):
            J, W, W1 = first / first1, sum(p) / p[s], sum(p1) / p1[s]
            ratio, brute_ratio = shifted / C, (f1 * J[:, None] / f).T
            # The share of strategy s, from this end, of a pair; over all of them, from both ends, they sum to 1.
            share, brute_share = 1 / (W + r * (1 + others)), p[s] / (sum(p) + J * sum(p1))
            pairs = [(r, p1[s] * J / p[s]), (1 + others, W1), (share, brute_share)]
            pairs += [(ratio[c], brute_ratio[c]) for c in range(3)]
            for number, (ours, theirs) in enumerate(pairs):
                error = np.abs(ours / theirs - 1)[good]
                # Of grazing directions float32 leaves little: some densities are 0 by one way and not by the other.
                assert np.isfinite(error).mean() > 0.97, number
                error = error[np.isfinite(error)]
                assert np.median(error) < 1e-3 and np.quantile(error, 0.97) < 0.02, (number, np.median(error))


@pytest.fixture(scope="module")
def paths(renderer):
    return Paths(renderer)


def vertices_of(paths, t):
    """The first ``t`` vertices of the camera path, of its copy, and where both are there, without mirrors."""
    from data_gen.paths.vertex import SMOOTH
    from data_gen.samplers.gbdpt.offset_path import own_vertex

    base = [step.z.si for step in paths.steps[:t]]
    good = paths.offsets[0].apart & (paths.dr.max(paths.offsets[t - 1].β) > 0)
    for step in paths.steps[: t - 1]:
        good &= step.goes_on & (step.kind == SMOOTH)
    return base, [own_vertex(paths.offsets[0], base[0]), *base[1:]], good


@pytest.mark.parametrize("t", [1, 2, 3, 4])
def test_copies_of_paths_to_a_light(paths, t):
    """The fourth vertex is one step behind what both have in common: an error of that step shows there alone."""
    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.vertex import cosine
    from data_gen.samplers.gbdpt.offset_path import own_vertex, to_same_light

    base, copy, good = vertices_of(paths, t)
    step, offset = paths.steps[t - 1], paths.offsets[t - 1]
    lamp = (step.light.p, step.light.n)
    if t < 3:
        si = own_vertex(offset, step.z.si)
        C, r, others = to_same_light(paths.plan, step, offset, si, si.bsdf(), good)
        r *= offset.r
    else:  # settled
        cos = cosine(step.z.si, step.light.d)
        others = mis.others_to_light(offset.end, step.e_light, step.light.pdf, cos, step.p_light, step.q_light)
        C, r = offset.β * step.f_light * step.weight, offset.r
    paths.compare(step.C_light, (C, r, others), paths.brute(base, lamp), paths.brute(copy, lamp), 1, good)


def joined(paths, t, s, end=None):
    """Arguments of ``compare`` for camera paths of ``t`` vertices connected to light paths of ``s``.

    ``end`` is what the copy's partial sums of weights are, if they are not its own.
    """
    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.strategies import connection
    from data_gen.samplers.bdpt.vertex import Vertex
    from data_gen.samplers.gbdpt.offset_path import own_vertex

    base, copy, good = vertices_of(paths, t)
    step, offset = paths.steps[t - 1], paths.offsets[t - 1]
    behind = [vertex.si for vertex, *_ in paths.from_light[:s]][::-1]
    y, there, *_ = paths.from_light[s - 1]
    good &= there & step.connectable
    for _, _, smooth, *_ in paths.from_light[: s - 1]:
        good &= smooth
    g, edge = connection(paths.scene, step.z, step.z.si.bsdf(), y, good)
    C, end = step.z.β * g, end or offset.end
    if t < 3:
        v = Vertex(own_vertex(offset, step.z.si), offset.β, end, step.z.depth)
        g, edge = connection(paths.scene, v, v.si.bsdf(), y, good, seen=offset.joined)
    others = mis.others_connected(end, y.end, edge)
    lamp = (paths.first.end.p, paths.first.end.n)
    brute = paths.brute(base + behind, lamp), paths.brute(copy + behind, lamp)
    return C, (offset.β * g, offset.r, others), *brute, s + 1, good


@pytest.mark.parametrize(("t", "s"), [(1, 1), (2, 1), (3, 1), (4, 1), (1, 2), (2, 2), (3, 2)])
def test_copies_of_paths_joined_to_light_paths(paths, t, s):
    paths.compare(*joined(paths, t, s))


def splatted(paths, s):
    """The light path of ``s`` vertices beside its light's own, ended at the camera."""
    from data_gen.paths.eye import Eye
    from data_gen.samplers.bdpt.strategies import to_camera
    from data_gen.samplers.gbdpt.light_shift import Splatted

    mi = paths.mi
    y, good, _, _, d = paths.from_light[s - 1]
    before, _, _, p, _ = paths.from_light[max(s - 2, 0)]
    for _, _, smooth, *_ in paths.from_light[: s - 1]:
        good &= smooth
    good &= paths.plan.materials.connectable(y.si.bsdf())
    nothing_between = lambda si, to, active: paths.scene.ray_test(si.spawn_ray_to(to.p), active)  # noqa: E731
    C, others, uv = to_camera(Eye.of(paths.camera), paths.lens, y, y.si.bsdf(), good, nothing_between)
    before_it = {"first": mi.Bool(s == 1), "start": paths.first, "before": before, "p": p, "survival": mi.Float(1)}
    return Splatted(y, d, uv, paths.lens, C, others, **before_it, events=mi.UInt32(0), allowed=mi.Bool(good))


def seen_elsewhere(paths, s):
    """The copy of ``splatted`` through another pixel: path, copy's place and vertex, and arguments of ``compare``."""
    from data_gen.paths.eye import Eye
    from data_gen.samplers.gbdpt.light_shift import shifted

    mi, scene, eye = paths.mi, paths.scene, Eye.of(paths.camera)
    path = splatted(paths, s)
    uv = path.uv + mi.Vector2f(*paths.SHIFT)
    good = path.allowed & eye.shows(uv) & (paths.dr.max(path.C) > 0)
    found = shifted(paths.plan, eye, path, uv, good)
    x = scene.ray_intersect(eye.ray(uv, paths.lens), good)
    behind = [vertex.si for vertex, *_ in paths.from_light[: s - 1]][::-1]
    lamp = (paths.first.end.p, paths.first.end.n)
    base, copy = paths.brute([path.y.si, *behind], lamp), paths.brute([x, *behind], lamp)
    return path, uv, x, (path.C, found, base, copy, s + 1, good)


@pytest.mark.parametrize("s", [1, 2, 3])
def test_copies_of_light_paths_to_the_camera(paths, s):
    """Against brute force; and the copy's copy is the path itself, with 1 / r."""
    from dataclasses import replace

    from data_gen.paths.eye import Eye
    from data_gen.samplers.bdpt.vertex import Vertex
    from data_gen.samplers.gbdpt.light_shift import shifted

    mi, dr, scene = paths.mi, paths.dr, paths.scene
    path, uv, x, (C, found, base, copy, _, good) = seen_elsewhere(paths, s)
    paths.compare(C, found, base, copy, s + 1, good)

    # And back
    C, r, others = found
    good &= dr.max(C) > 0
    origin = paths.first.end.p if s == 1 else path.before.si.p
    d = dr.normalize(mi.Vector3f(x.p - origin))
    start = path.start
    if s == 1:
        start, *_ = paths.plan.lights.redirected(scene, path.start, x)
        p = path.p
    else:
        before = path.before.si
        p = before.bsdf().pdf(mi.BSDFContext(), before, before.to_local(d))
    y = Vertex(x, path.y.β, path.y.end, path.y.depth)
    back = replace(path, y=y, d=d, uv=uv, C=C, others=others, start=start, p=p)
    C, r_back, others = shifted(paths.plan, Eye.of(paths.camera), back, path.uv, good)
    good = np.array(good & (dr.max(C) > 0))
    assert good.sum() > 100
    error = np.abs(np.array(r, np.float64) * np.array(r_back, np.float64) - 1)[good]
    assert np.median(error) < 5e-4 and np.quantile(error, 0.98) < 2e-2
    error = np.abs(np.array(others, np.float64) / np.array(path.others, np.float64) - 1)[good]
    assert np.quantile(error, 0.98) < 2e-2


def test_going_straight_to_a_vertex_and_back(paths):
    """r(T(x)) r(x) = 1 of the camera path's shift, and the copy's copy has the throughput of the path."""
    from dataclasses import replace

    from data_gen.samplers.bdpt.vertex import Vertex, evaluate
    from data_gen.samplers.gbdpt.offset_path import reconnect

    mi, dr, plan = paths.mi, paths.dr, paths.plan
    step, offset = paths.steps[0], paths.offsets[0]
    base, (own, *_), good = vertices_of(paths, 2)
    good &= paths.offsets[1].joined
    none = replace(offset, β=mi.Spectrum(0))
    there, _, _ = reconnect(plan, step, offset, none, own, own.bsdf())
    d = there.ray.d
    _, p, _ = evaluate("Radiance", own, own.bsdf(), own.to_local(d), good)
    z = Vertex(own, offset.β, offset.end, step.z.depth)
    reverse = replace(step, z=z, wo=own.to_local(d), d=d, p=p, survival=mi.Float(1))
    x = base[0]
    as_offset = replace(offset, β=step.z.β, r=mi.Float(1), end=step.z.end, apart=mi.Bool(True))
    back, _, _ = reconnect(plan, reverse, as_offset, none, x, x.bsdf())
    good = np.array(good & (dr.max(back.β) > 0))
    assert good.sum() > 1000
    error = np.abs(np.array(there.r, np.float64) * np.array(back.r, np.float64) - 1)[good]
    assert np.median(error) < 5e-4 and np.quantile(error, 0.98) < 1e-2
    ends = np.array(back.end.vcm, np.float64) / np.array(step.end1.vcm, np.float64)
    assert np.quantile(np.abs(ends - 1)[good], 0.98) < 1e-2


@pytest.fixture
def rough_roulette(monkeypatch):
    """Few survive."""
    from data_gen.samplers.gbdpt import roulette

    monkeypatch.setattr(roulette, "SHARE", 0.4)


def shares_lost(renderer, monkeypatch, seeds=6):
    """For each seed the share of the differences without roulette that is missing with it: of the same paths, so that
    the noise is that of the roulette alone. Its mean is 0."""
    from data_gen.samplers.gbdpt import integrator

    def gradients():
        stacks = render_ours(load(renderer, "diffuse", (16, 16)), "gbdpt", seeds, 64, FAR)
        return np.stack([np.stack([stack["dx"], stack["dy"]]) for stack in stacks]).astype(np.float64)

    with_it = gradients()
    all_survive = lambda camera, rater, lane, depth, threshold: (lane, depth, renderer.Float(1))  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(integrator, "survivors", all_survive)
        without = gradients()
    mean = without.mean(axis=0)
    return ((with_it - without) * mean).sum(axis=(1, 2, 3, 4)) / (mean**2).sum()


def z_of(values):
    return values.mean() / (values.std(ddof=1) / np.sqrt(len(values)))


def test_roulette_leaves_differences_as_they_are(renderer, long_passes, rough_roulette, monkeypatch):
    lost = shares_lost(renderer, monkeypatch)
    # Student's t, 5 degrees of freedom: p = 0.001
    assert 0 < np.abs(lost).max() < 0.1 and abs(z_of(lost)) < 6.9, lost
    # Survivors that are counted once lose 2 % and more.
    assert abs(lost.mean()) < 0.02


def test_who_survives(renderer):
    """By 1 / p, as ``roulette`` has it, and by numbers of their own for each vertex and seed."""
    import drjit as dr

    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers.gbdpt.roulette import LEAST, RATED, SHARE, Worth, survivors

    mi, sensor = renderer, load(renderer, "diffuse", (32, 32)).sensors()[0]
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


@pytest.mark.parametrize("name", ["lens", "glossy"])
def test_what_the_camera_has_seen_is_found_again(renderer, name):
    """The second kernel splats what the first one has splatted, and never a vertex that was not seen."""
    import drjit as dr

    from data_gen.film.splats import Splats
    from data_gen.paths.camera import CameraSamples
    from data_gen.paths.eye import Sight
    from data_gen.samplers.bdpt.light_path import Seen, light_path
    from data_gen.samplers.bdpt.strategies import to_camera
    from data_gen.samplers.gbdpt.light_again import Marker, light_again, marked

    mi, scene = renderer, load(renderer, name, (32, 24))
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
    seen = lambda *_: mi.Bool(False)  # noqa: E731
    C, others, uv = to_camera(some.eye, again.lens, end.y, end.y.si.bsdf(), there, seen)
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


def test_mirrors_in_front_of_the_camera_are_followed(renderer, long_passes, monkeypatch):
    """A wall of mirror shows the room as if through a window."""
    from data_gen.samplers.gbdpt import offset_path

    def behind_a_mirror():
        from data_gen.scenes.builtin import _wall

        scene = corner()
        del scene["mirror"]
        scene["back"] = _wall([0, 1, -1.2], [0, 0, 1], (6, 3), {"type": "conductor", "material": "Al"})
        return scene

    def noise():
        # Independent points: claims of four batches of a net go by few pixels here.
        layers = render_ours(load(renderer, behind_a_mirror, (24, 24)), "gbdpt", 1, 256, points="independent")[0]
        return layers["dx_var"].mean() + layers["dy_var"].mean()

    followed = noise()

    def reject(plan, step, y, none, si, bsdf):
        return none, renderer.Spectrum(0), renderer.Float(0)

    monkeypatch.setattr(offset_path, "replay", reject)
    # What splats and the rest of the room add is the same in both.
    assert followed < 0.8 * noise()
