"""Light paths of ``gbdpt`` that reach the camera's first vertex through mirrors and glass, and their copies."""

import numpy as np
import pytest
from bdpt_ends import close, number, plan_of
from bdpt_scenes import LIT, by_a_wall, by_the_sun
from unbiased import load, render_ours


class Caustics:
    """One light path of each lane up to the first vertex behind mirrors or glass, which the camera sees."""

    LENGTH = 5

    def __init__(self, mi, description):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.paths.eye import Eye
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.strategies import to_camera
        from data_gen.samplers.bdpt.vertex import IMPORTANCE, Vertex, context, cosine, light_leaves, scatters_smoothly
        from data_gen.samplers.gbdpt.light_again import first_link, next_link
        from data_gen.samplers.gbdpt.light_shift import Splatted

        self.mi, self.dr = mi, dr
        self.scene = scene = load(mi, description, (32, 32))
        self.camera = camera = CameraSamples(scene.sensors()[0], 1, 64)
        self.plan = plan_of(scene)
        lights, materials = self.plan.lights, self.plan.materials
        ray, _, _ = camera.rays()
        random = camera.random.clone()
        start = lights.sample(scene, random, ray.time, ray.wavelengths)
        si, d, β = scene.ray_intersect(start.ray), start.ray.d, start.β
        e, p = lights.densities(scene, start, si)
        end, there = mis.begin_light(e, p, start.delta, cosine(si, d)), si.is_valid()
        link = first_link()
        kept = Vertex(si, β, end, mi.UInt32(0))
        found = (Vertex(si, β, end, mi.UInt32(0)), mi.Vector3f(d), link, kept, mi.Bool(False))
        for depth in range(1, self.LENGTH + 1):
            y, bsdf = Vertex(si, mi.Spectrum(β), end, mi.UInt32(depth)), si.bsdf()
            good = there & (link.events != 0) & link.whole & scatters_smoothly(bsdf) & materials.connectable(bsdf)
            found = dr.select(good & ~found[4], (y, mi.Vector3f(d), link, kept, good), found)
            kept = dr.select(there & scatters_smoothly(bsdf), y, kept)
            sample, f_p = bsdf.sample(context(IMPORTANCE), si, random.next_1d(), random.next_2d(), there)
            d, f_p, end = light_leaves(y, bsdf, sample, f_p, there)
            β = β * f_p
            link = next_link(link, mi.UInt32(depth), sample, mi.Float(1))
            there &= sample.pdf > 0
            si = scene.ray_intersect(si.spawn_ray(d), there)
            there &= si.is_valid()
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
            dr.eval(found, kept, si, d, β, end, link, there)
        y, d, link, before, good = found
        nothing_between = lambda si, to, active: scene.ray_test(si.spawn_ray_to(to.p), active)  # noqa: E731
        C, others, uv = to_camera(Eye.of(camera), camera.lens, y, y.si.bsdf(), good, nothing_between)
        before_it = {"first": link.depth == 0, "start": start, "before": before, "p": link.p}
        before_it |= {"survival": link.survival, "events": link.events}
        self.path = Splatted(y, d, uv, camera.lens, C, others, **before_it, allowed=good)
        dr.eval(self.path)

    def shift(self, path, uv, active):
        """(C', r, others') at that place on the film."""
        from data_gen.paths.eye import Eye
        from data_gen.samplers.gbdpt.light_shift import shifted

        return shifted(self.plan, Eye.of(self.camera), path, uv, active, True)

    def copy(self, path, pixels):
        """Its copy so many pixels to the right and half as many down: where it is, and C', r, others'."""
        from data_gen.paths.eye import Eye

        uv = path.uv + self.mi.Vector2f(pixels, pixels / 2)
        active = path.allowed & Eye.of(self.camera).shows(uv) & (self.dr.max(path.C) > 0)
        return uv, active, self.shift(path, uv, active)


# By a lamp and by one direction; the others are slow.
@pytest.fixture(
    scope="module", params=[n if n in ("lamp", "sun") else pytest.param(n, marks=pytest.mark.slow) for n in LIT]
)
def paths(renderer, request):
    return Caustics(renderer, LIT[request.param])


def test_a_path_is_its_own_copy_in_its_own_place(paths):
    _, good, (C, r, others) = paths.copy(paths.path, 0)
    assert np.array(good).sum() > 500
    found = np.array(paths.dr.max(C) > 0)[np.array(good)]
    assert found.mean() > 0.9
    good &= paths.dr.max(C) > 0
    close(C, paths.path.C, good)
    close(r, 1, good)
    close(others, paths.path.others, np.array(good) & (np.array(paths.path.others) > 0))


def moved_path(paths, uv, good):
    """The copy at ``uv`` as if light had found it: traced forward from the vertex that stays."""
    from dataclasses import replace

    from data_gen.paths.eye import Eye
    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.strategies import to_camera
    from data_gen.samplers.bdpt.vertex import IMPORTANCE, Vertex, context, cosine, evaluate, light_leaves
    from data_gen.samplers.gbdpt.light_shift import through_glass

    mi, dr, scene, camera, path = paths.mi, paths.dr, paths.scene, paths.camera, paths.path
    x = scene.ray_intersect(Eye.of(camera).ray(uv, path.lens), good)
    d, β, *_ = through_glass(paths.plan, path, x, good & x.is_valid())
    good &= dr.max(β) > 0
    dr.eval(x, d, good)
    # ------------------- To the vertex that stays ----------------
    events, ray, last = mi.UInt32(path.events), x.spawn_ray(-d), mi.Point3f(x.p)
    for _ in range(6):
        here = good & (events != 0)
        si = scene.ray_intersect(ray, here)
        last = dr.select(here, si.p, last)
        sample, _ = si.bsdf().sample(mi.BSDFContext(), si, number(mi, dr, events & 3), mi.Point2f(0.5), here)
        ray = dr.select(here, si.spawn_ray(si.to_world(sample.wo)), ray)
        events >>= 2
        dr.eval(events, ray, last)
    # -------------------------- And back -------------------------
    beyond = mi.SurfaceInteraction3f(x)
    beyond.p = last
    start, ratio, _ = paths.plan.lights.redirected(scene, path.start, beyond)
    start.β /= ratio
    before = path.before.si
    away = dr.normalize(last - before.p)
    f, p, q = evaluate(IMPORTANCE, before, before.bsdf(), before.to_local(away), good & ~path.first)
    # What is infinitely far away begins elsewhere.
    far = path.first & paths.plan.lights.far(path.start.index)
    origin = dr.select(far, last - 3 * start.ray.d, start.end.p)
    ray = dr.select(path.first, mi.Ray3f(origin, start.ray.d), before.spawn_ray(away))
    d = dr.select(path.first, start.ray.d, away)
    β = dr.select(path.first, start.β, path.before.β * f / p)
    end = mis.leave(path.before.end, cosine(before, d), p, q, mi.Bool(False))
    si = scene.ray_intersect(ray, good)
    e, p_light = paths.plan.lights.densities(scene, start, si)
    begun = mis.begin_light(e, p_light, start.delta, cosine(si, d))
    end = dr.select(path.first, begun, mis.arrive(end, cosine(si, d), dr.square(si.t)))
    forward = [(path.events >> (2 * k)) & 3 for k in range(5, -1, -1)]
    for code in forward:
        here = good & (code != 0)
        y, bsdf = Vertex(si, β, end, mi.UInt32(1)), si.bsdf()
        sample, f_p = bsdf.sample(context(IMPORTANCE), si, number(mi, dr, code), mi.Point2f(0.5), here)
        d_next, f_p, left = light_leaves(y, bsdf, sample, f_p, here)
        β = dr.select(here, β * f_p, β)
        reached = scene.ray_intersect(si.spawn_ray(d_next), here)
        left = mis.arrive(left, cosine(reached, d_next), dr.square(reached.t))
        si, d, end = dr.select(here, reached, si), dr.select(here, d_next, d), dr.select(here, left, end)
        dr.eval(si, d, β, end)
    y = Vertex(si, β, end, path.y.depth)
    C, others, uv_back = to_camera(
        Eye.of(camera),
        path.lens,
        y,
        si.bsdf(),
        good,
        lambda si, to, active: scene.ray_test(si.spawn_ray_to(to.p), active),
    )
    p_new = dr.select(path.first, path.p, p)
    moved = replace(path, y=y, d=d, uv=uv_back, C=C, others=others, start=start, p=p_new)
    dr.eval(moved, good)
    return moved, good


def test_copies_are_paths_that_light_could_have_found(paths):
    """C' / r is the contribution of the copy by its own density, traced forward; weights are those along it; and the
    copy's copy is the path, with 1 / r."""
    uv, active, (C, r, others) = paths.copy(paths.path, 0.25)
    asked = np.array(active).sum()
    good = active & (paths.dr.max(C) > 0)
    # Of large curved things; where a copy would leave them, there is none.
    assert np.array(good).sum() > 0.4 * asked, (np.array(good).sum(), asked)
    moved, good = moved_path(paths, uv, good)
    offset = np.linalg.norm(np.array(moved.uv - uv), axis=0)[np.array(good)]
    assert np.quantile(offset, 0.95) < 0.1
    lit = good & (paths.dr.max(moved.C) > 0)
    assert np.array(lit).sum() > 0.9 * np.array(good).sum()
    close(C / r, moved.C, lit, most=0.1)
    close(others, moved.others, np.array(lit) & (np.array(others) > 0), most=0.1)
    C_back, r_back, _ = paths.shift(moved, paths.path.uv, lit)
    back = lit & (paths.dr.max(C_back) > 0)
    assert np.array(back).sum() > 0.97 * np.array(lit).sum()
    close(r * r_back, 1, back, median=1e-2, most=0.1)
    close(C_back * r, paths.path.C, back, median=1e-2, most=0.1)


def test_what_is_bent_is_shifted_by_a_kernel_of_its_own(renderer, monkeypatch):
    """All of it, and from the vertex that light has left: Dr.Jit 1.5 (LLVM) once read another lane's."""
    import drjit as dr

    from data_gen.paths.frozen import evaluated
    from data_gen.render import render_stack
    from data_gen.samplers.gbdpt import integrator, light_shift

    found, differences = {False: renderer.UInt32(0), True: renderer.UInt32(0)}, light_shift.differences

    def counted(plan, eye, path, lit, bent=False):
        # A light path without a vertex of its own to come from is the light's.
        there = path.first | (path.before.depth > 0)
        dr.scatter_add(found[bent], 1, 0, (dr.max(path.C) > 0) & (path.events != 0) & path.allowed & there)
        return differences(plan, eye, path, lit, bent)

    monkeypatch.setattr(light_shift, "differences", counted)
    # Not frozen: what is counted is no argument, so a recorded kernel would count in its first pass only.
    plain = lambda f, *args, sums=None: evaluated(f)(*args, *([sums()] if sums else []))  # noqa: E731
    monkeypatch.setattr(integrator, "Frozen", lambda *_: plain)
    stack = render_stack(load(renderer, by_a_wall, (32, 32)), 64, 3, "gbdpt")
    first, again = (int(np.array(found[bent])[0]) for bent in (False, True))
    # 293 and 39 of 1120 where the vertex before was another's.
    assert stack["primal"].any() and first == again > 1000, (first, again)


@pytest.fixture
def long_passes(monkeypatch):
    """A pass of 64 samples per pixel: much less of the time goes by with recording kernels."""
    from dataclasses import replace

    from data_gen.samplers import SAMPLERS

    for name in ("bdpt", "gbdpt"):
        monkeypatch.setitem(SAMPLERS, name, replace(SAMPLERS[name], batch=64))


@pytest.mark.slow
def test_less_noise_than_without(renderer, long_passes, monkeypatch):
    """Light of one direction, through a ball and by a mirror, and straight onto the floor."""
    from data_gen.samplers.gbdpt import light_shift

    scene = load(renderer, by_the_sun, (48, 48))

    def noise():
        layers = render_ours(scene, "gbdpt", 1, 128)[0]
        return layers["dx_var"].mean() + layers["dy_var"].mean()

    followed = noise()

    def lost(plan, path, x, active):
        return renderer.Vector3f(path.d), renderer.Spectrum(0), renderer.Float(0), renderer.Float(0)

    monkeypatch.setattr(light_shift, "through_glass", lost)
    without = noise()
    assert followed < 0.5 * without, (followed, without)
