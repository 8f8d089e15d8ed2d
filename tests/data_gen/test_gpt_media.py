"""``gpt`` through media: unbiased, undone by the reverse shift, better than pixels, and absent where there are none.

Wide pixels: 16 x 16 of them see a room from near by, and shifts go over four. On finer images wrong densities drown in
the noise. Beside the largest z of a block the sum of all z² is tested, which sees errors that are everywhere.
"""

import gc
from functools import cache

import numpy as np
import pytest
from data_gen_scenes import fog, within_fog
from media_scenes import (
    before_the_sky,
    by_mis,
    coloured_smoke,
    colours,
    dense,
    forward,
    haze,
    hiding,
    hiding_outside,
    hovering,
    milk,
    nested,
    smoke,
    standing,
)
from scipy.stats import chi2, norm
from unbiased import differences, gradient_tests, light_apart, load, render_ours, render_references

from ngpt.testing import z_test

SIZE, PIXELS = (16, 16), 4
# Not with large budgets: those tell `volpathmis` from `volpath`.
FAST = [haze, by_mis(colours), before_the_sky]
SLOW = [haze, forward, colours, dense, milk, nested, smoke, coloured_smoke, before_the_sky, fog, within_fog]
SLOW += [hiding, hiding_outside, by_mis(coloured_smoke), hovering, standing]


@cache
def references_of(mi, description, batches, spp):
    return render_references(mi, load(mi, description, SIZE), batches, spp)


def disagreement(stacks, references, pixels, block=4):
    """The probability of so large a sum of z² over blocks of grey pixels of dx and dy, were they unbiased."""
    total, count = 0.0, 0
    slopes = [differences(reference, pixels) for reference in references]
    for axis, name in enumerate(("dx", "dy")):
        ours = np.stack([stack[name] + differences(light_apart(stack), pixels)[axis] for stack in stacks])
        theirs = np.stack([slope[axis] for slope in slopes])
        result = z_test(*(images.mean(axis=-1, keepdims=True) for images in (ours, theirs)), block=block)
        z = norm.isf(result.p / 2)[result.z != 0]
        total, count = total + (z**2).sum(), count + z.size
    return chi2.sf(total, count)


def verdict(mi, description, batches, spp, pixels=PIXELS):
    """What is wrong with the gradients, "" if nothing is."""
    references = references_of(mi, description, batches, 2 * spp)
    stacks = render_ours(load(mi, description, SIZE), "gpt", batches, spp, pixels)
    wrong = [
        f"{name}: {result}" for name, result in gradient_tests(stacks, references, pixels=pixels) if not result.passed
    ]
    p = disagreement(stacks, references, pixels)
    return "; ".join(wrong + ([f"sum of z²: p = {p:.1e}"] if p < 1e-3 else []))


@pytest.mark.parametrize("scene", FAST)
def test_unbiased(renderer, scene):
    assert verdict(renderer, scene, 12, 64) == ""


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [1, PIXELS])
@pytest.mark.parametrize("scene", SLOW)
def test_unbiased_with_a_large_budget(renderer, scene, pixels):
    assert verdict(renderer, scene, 24, 512, pixels) == ""


def test_camera_rays_meet_coplanar_surfaces_as_those_of_volpath(renderer):
    """Of a boundary that lies in the floor Embree finds one or the other, and it matters how rays are traced.

    The sky is seen through the floor where it finds the boundary. Coherent rays saw half as much of it.
    """
    scene = load(renderer, lambda: standing() | {"integrator": {"type": "volpath", "max_depth": 1}}, SIZE)
    ours, theirs = render_ours(scene, "gpt", 1, 256)[0]["primal"], render_references(renderer, scene, 1, 1024)[0]
    through_the_floor = np.s_[13:16, 4:12]
    assert 0.05 < theirs[through_the_floor].mean() < 0.95
    assert abs(ours[through_the_floor].mean() / theirs[through_the_floor].mean() - 1) < 0.1


# ------------------------------- Mutants ------------------------------


def no_jacobian(monkeypatch):
    jacobian_is(monkeypatch, lambda ratio, *_: 1)


def cubed(monkeypatch):
    jacobian_is(monkeypatch, lambda ratio, *_: ratio**1.5)


def cosine(monkeypatch):
    """As if the vertex in the medium were on a surface, across the view."""
    import drjit as dr

    jacobian_is(
        monkeypatch,
        lambda ratio, base, offset: ratio * dr.abs(dr.normalize(offset).z / dr.normalize(base).z),
    )


def jacobian_is(monkeypatch, wrong):
    import drjit as dr

    from data_gen.paths import shift

    right = shift.reconnection_jacobian

    def changed(base, offset, target, normal, in_medium=None):
        J = right(base, offset, target, normal, in_medium)
        ratio = dr.squared_norm(base - target) / dr.squared_norm(offset - target)
        return dr.select(in_medium, wrong(ratio, base - target, offset - target), J)

    monkeypatch.setattr(shift, "reconnection_jacobian", changed)


def reconnect_is(monkeypatch, wrong):
    from data_gen.paths import segments

    right = segments.reconnect

    def changed(*args, **more):
        T, T_c, blocked = right(*args, **more)
        return *wrong(T, T_c, more["base"]), blocked

    monkeypatch.setattr(segments, "reconnect", changed)


def no_transmittance(monkeypatch):
    reconnect_is(monkeypatch, lambda T, T_c, base: (base.weight, 1))


def scattering_twice(monkeypatch):
    """σs = 0.36, that of the haze."""
    import drjit as dr

    reconnect_is(monkeypatch, lambda T, T_c, base: (dr.select(base.place.scatters, 0.36 * T, T), T_c))


def rejected_halves(monkeypatch):
    import drjit as dr

    from data_gen.paths import shift

    monkeypatch.setattr(shift, "gradient_weight", lambda r, good: dr.select(good, 2 / (1 + r), 1))


def list_forgotten(monkeypatch):
    """The null collisions of the offset path have the density of those of the base path."""
    from data_gen.paths import collisions

    right = collisions.rescale

    def changed(*args, **more):
        τ, hit, last, medium, N, N_c = right(*args, **more)
        return τ, hit, last, medium, N / N, N_c / N_c

    monkeypatch.setattr(collisions, "rescale", changed)


def list_without_jacobian(monkeypatch):
    import drjit as dr

    monkeypatch.setattr("data_gen.paths.collisions.list_jacobian", lambda scale, n: dr.full(type(scale), 1))


# With the least batches and samples that showed them.
MUTANTS = [
    (no_jacobian, haze, 16, 128),
    (cubed, haze, 16, 128),
    (cosine, haze, 16, 128),
    (no_transmittance, dense, 16, 128),
    (scattering_twice, haze, 24, 512),
    (rejected_halves, milk, 24, 256),
    (list_forgotten, smoke, 16, 64),
    (list_without_jacobian, smoke, 16, 128),
]


@pytest.mark.slow
@pytest.mark.parametrize(("mutant", "scene", "batches", "spp"), MUTANTS)
def test_mutants_die(renderer, monkeypatch, mutant, scene, batches, spp):
    mutant(monkeypatch)
    assert verdict(renderer, scene, batches, spp)


# ------------------------------ Segments ------------------------------


class Ways:
    """Segments from a point x of a scene along random directions, and the ways of a point y to where they end."""

    LANES = 1 << 16

    def __init__(self, mi, description, x=(-0.3, 0.2, 0.3), y=(-0.22, 0.27, 0.36), seed=3, **aim):
        import drjit as dr

        from data_gen.paths import media, segments
        from data_gen.paths.streams import sample_streams

        self.mi, self.dr, self.segments = mi, dr, segments
        self.scene = load(mi, description, (4, 4))
        self.media = media.Media(self.scene)
        self.channel = mi.UInt32(1)
        lanes = dr.arange(mi.UInt32, self.LANES)
        self.random = sample_streams(seed, lanes, dr.zeros(mi.UInt32, self.LANES))
        self.x, self.y = self.point(x), self.point(y)
        self.around = self.place(self.x), self.place(self.y)
        direction = aim.get("direction") or mi.warp.square_to_uniform_sphere(self.random.next_2d())
        self.numbers = segments.draw(self.random, self.media)
        ray = self.x.spawn_ray(mi.Vector3f(direction) + dr.zeros(mi.Vector3f, self.LANES))
        trace = segments.next_surface(self.scene)
        self.base = segments.fly(
            self.media, trace, ray, self.around[0].medium, self.channel, self.numbers, active=mi.Bool(True)
        )
        self.end = media.vertex(self.base.ray, self.base.hit, self.base.place)
        self.direction = ray.d

    def point(self, p):
        """A vertex in the air there."""
        si = self.dr.zeros(self.mi.SurfaceInteraction3f, self.LANES)
        si.p, si.t = self.mi.Point3f(*p) + self.dr.zeros(self.mi.Point3f, self.LANES), self.mi.Float(1)
        return si

    def place(self, x):
        """In the medium that a way from the camera leads to."""
        from data_gen.paths.media import Place

        mi, dr = self.mi, self.dr
        camera = self.point((0.2, 0.3, 2.2))
        ray, reach = camera.spawn_ray_to(x.p), dr.norm(x.p - camera.p)
        trace, medium = self.segments.next_surface(self.scene), mi.MediumPtr(self.scene.sensors()[0].get_medium())
        medium = self.segments.cross(self.media.passes, trace, ray, medium, reach, active=mi.Bool(True), target=None)[
            -1
        ]
        return Place(medium, mi.Bool(True))

    def reconnect(self, y, place, base):
        direction = self.dr.select(self.end.is_valid(), self.dr.normalize(self.end.p - y.p), self.direction)
        ray = self.dr.select(self.end.is_valid(), y.spawn_ray_to(self.end.p), y.spawn_ray(direction))
        of_base = {"x1": self.end, "base": base, "channel": self.channel, "active": self.mi.Bool(True)}
        T, T_c, blocked = self.segments.reconnect(self.scene, self.media, y, place, ray, **of_base)
        return np.array(T).T, np.array(T_c), np.array(blocked)


@pytest.mark.parametrize("scene", [haze, colours, nested, smoke, coloured_smoke])
def test_a_segment_shifted_to_itself_is_itself(renderer, scene):
    """Its null collisions too, which are made anew."""
    ways = Ways(renderer, scene)
    T, T_c, blocked = ways.reconnect(ways.x, ways.around[0], ways.base)
    assert blocked.mean() < 1e-3
    weight = np.array(ways.base.weight).T
    if ways.media.grids:
        assert np.array(ways.base.nulls.n).mean() > 0.3
    assert (np.abs(T_c - 1) < 2e-3)[~blocked].mean() > 0.999
    assert (np.abs(T - weight) < 2e-3 * np.abs(weight).max())[~blocked].mean() > 0.999


def test_segments_to_a_surface_behind_a_boundary_are_not_blocked_by_it(renderer):
    """Rays are displaced behind boundaries: nearly all of these were, and ``dy`` was off by 1 % of the light."""
    ways = Ways(renderer, hovering, x=(-0.3, -0.85, 0.3))
    *_, blocked = ways.reconnect(ways.x, ways.around[0], ways.base)
    floor = np.array(ways.end.is_valid() & (ways.end.p.y < -0.999))
    assert floor.mean() > 0.1
    assert blocked[floor].mean() < 1e-3


@pytest.mark.parametrize("scene", [haze, colours, nested])
def test_the_shift_of_the_shift_is_the_segment(renderer, scene):
    """In homogeneous media r(T(x)) r(x) = 1."""
    from dataclasses import replace

    ways = Ways(renderer, scene)
    _, T_c, blocked = ways.reconnect(ways.y, ways.around[1], ways.base)
    assert np.mean(~blocked) > 0.5 and np.std(np.log(T_c[~blocked])) > 0.02
    shifted = replace(ways.base, τ_c=ways.base.τ_c - ways.mi.Float(np.log(T_c)))
    _, back, also_blocked = ways.reconnect(ways.x, ways.around[0], shifted)
    assert np.mean(also_blocked[~blocked]) < 1e-3
    assert (np.abs(T_c * back - 1) < 2e-3)[~blocked].mean() > 0.999


@pytest.mark.parametrize("scene", [nested, smoke, coloured_smoke])
def test_shifted_segments_carry_what_comes_through(renderer, scene):
    """All base segments that reach the same point, shifted, make the transmittance of the other way to it."""
    ways = Ways(renderer, scene, direction=(0.05, -0.6, -0.4))
    arrives = ~np.array(ways.base.place.scatters)
    assert 0.02 < arrives.mean() < 0.95
    T, _, blocked = ways.reconnect(ways.y, ways.around[1], ways.base)
    assert not blocked[arrives].any()
    shifted = np.where(arrives[:, None], T, 0)
    first = int(np.argmax(arrives))
    target = ways.mi.Point3f(*(float(c[first]) for c in np.array(ways.end.p)))
    drawn = {"channel": ways.channel, "key": ways.random.next_key(), "active": ways.mi.Bool(True)}
    through = ways.segments.transmittance(ways.scene, ways.media, ways.y, ways.around[1], target, **drawn)
    through = np.array(through).T + np.zeros_like(shifted)
    error = np.sqrt((shifted.var(axis=0) + through.var(axis=0)) / len(shifted))
    difference = shifted.mean(axis=0) - through.mean(axis=0)
    assert (np.abs(difference) < 4 * error + 1e-3 * through.mean(axis=0)).all(), (difference, error)
    # It is not what comes through on the base path's way.
    weights = np.where(arrives[:, None], np.array(ways.base.weight).T, 0)
    assert (np.abs(weights.mean(axis=0) - through.mean(axis=0)) > 4 * error).any()


# --------------------------- Cost and worth ---------------------------


def test_gradients_have_less_noise_than_pixels(renderer):
    """Measured: 21 and 16 in haze. A sampler that rejects every shift is unbiased."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    scene = load(renderer, haze, (32, 32))
    stack = render_stack(scene, 64, 0, "gpt", diagnostics=True)
    noise = stack["primal_var"][:, 1:] + stack["primal_var"][:, :-1]
    assert noise.sum() / stack["dx_var"][:, :-1].sum() > 8
    assert pass_through(stack)["diagnostics.shiftFailures"].mean() < 0.1


def test_a_scene_without_media_knows_nothing_of_them(renderer, monkeypatch):
    """Its kernel has not one operation for them: functions that know media are called without, or not at all."""
    import drjit as dr

    from data_gen.paths import collisions, media, segments
    from data_gen.render import render_stack

    scene, called = load(renderer, "glossy", (8, 6)), []
    kinds = (media.Media, media.Place, segments.Numbers)

    def operations():
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            render_stack(scene, 4, 0, "gpt")
            return max(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))

    def without_media(name, function):
        def wrapped(*args, **more):
            called.append(name)
            assert not any(isinstance(value, kinds) for value in (*args, *more.values())), name
            return function(*args, **more)

        return wrapped

    # Objects of other tests that go in between are operations less.
    gc.collect()
    before = operations()
    for room in (media, segments, collisions):
        for name, function in vars(room).items():
            if callable(function) and not isinstance(function, type) and function.__module__ == room.__name__:
                monkeypatch.setattr(room, name, without_media(name, function))
    assert operations() == before and "vertex" in called


def test_shifts_that_know_no_media_say_so(renderer):
    from data_gen.render import render_stack
    from ngpt.errors import NgptError

    scene = load(renderer, haze, (4, 4))
    for shift in ("half-vector", "manifold"):
        with pytest.raises(NgptError, match=f"gpt: shift '{shift}' does not go through media"):
            render_stack(scene, 1, sampler="gpt", shift=shift)


def test_mono_variant(renderer):
    from data_gen.backend import use_variant

    use_variant("llvm_ad_mono")
    try:
        import mitsuba as mi

        scene = load(mi, coloured_smoke, SIZE)
        stacks = render_ours(scene, "gpt", 12, 48, PIXELS)
        references = np.broadcast_to(render_references(mi, scene, 12, 96), (12, *SIZE, 3))
        for name, result in gradient_tests(stacks, references, pixels=PIXELS):
            assert result.passed, f"{name}: {result}"
    finally:
        use_variant("llvm_ad_rgb")


def test_spectral_variant(renderer):
    from data_gen.backend import use_variant

    use_variant("llvm_ad_spectral")
    try:
        import mitsuba as mi

        stacks = render_ours(load(mi, colours, SIZE), "gpt", 12, 48)
        references = render_references(mi, load(mi, colours, SIZE), 12, 96)
        for name, result in gradient_tests(stacks, references):
            assert result.passed, f"{name}: {result}"
        render_ours(load(mi, coloured_smoke, (4, 4)), "gpt", 1, 1)
    finally:
        use_variant("llvm_ad_rgb")
