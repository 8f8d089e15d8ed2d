"""Shifts of ``gpt`` through media: undone by the reverse shift, and absent where there are no media."""

import gc

import numpy as np
import pytest
from media_scenes import (
    coloured_smoke,
    colours,
    haze,
    hovering,
    nested,
    smoke,
    standing,
)
from unbiased import load, render_ours

SIZE = (16, 16)


def test_camera_rays_meet_coplanar_surfaces_as_those_of_volpath(renderer):
    """Of a boundary that lies in the floor Embree finds one or the other, and it matters how rays are traced.

    The sky is seen through the floor where it finds the boundary. Coherent rays saw half as much of it.
    """
    scene = load(renderer, lambda: standing() | {"integrator": {"type": "volpath", "max_depth": 1}}, SIZE)
    ours, theirs = render_ours(scene, "gpt", 1, 256)[0]["primal"], np.array(renderer.render(scene, spp=1024))
    through_the_floor = np.s_[13:16, 4:12]
    assert 0.05 < theirs[through_the_floor].mean() < 0.95
    assert abs(ours[through_the_floor].mean() / theirs[through_the_floor].mean() - 1) < 0.1


# ------------------------------- Mutants ------------------------------


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
