"""Shifts of ``gpt`` through media: segments undone by the reverse shift, and worth what comes through."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from media_scenes import coloured_smoke, colours, haze, hovering, nested, smoke, standing
from unbiased import load, render_ours

from data_gen.paths import media, segments
from data_gen.paths.media import Place
from data_gen.paths.streams import sample_streams


def test_camera_rays_meet_coplanar_surfaces_as_those_of_volpath(renderer):
    """Where a boundary lies in the floor, Embree finds one or the other, and it matters how rays are traced.

    The sky is seen through the floor where it finds the boundary. Coherent rays saw half as much of it.
    """
    scene = load(renderer, lambda: standing() | {"integrator": {"type": "volpath", "max_depth": 1}}, (16, 16))
    ours, theirs = render_ours(scene, "gpt", 1, 256)[0]["primal"], np.array(renderer.render(scene, spp=1024))
    through_the_floor = np.s_[13:16, 4:12]
    assert 0.05 < theirs[through_the_floor].mean() < 0.95
    assert abs(ours[through_the_floor].mean() / theirs[through_the_floor].mean() - 1) < 0.1


class Ways:
    """Segments from a point x of a scene along random directions, or one, and the ways of a point y to their ends."""

    LANES = 1 << 16
    YES = property(lambda self: mi.Bool(True))

    def __init__(self, description, x=(-0.3, 0.2, 0.3), direction=None):
        self.scene = load(mi, description, (4, 4))
        self.media, self.channel = media.Media(self.scene), mi.UInt32(1)
        self.random = sample_streams(3, dr.arange(mi.UInt32, self.LANES), dr.zeros(mi.UInt32, self.LANES))
        self.x, self.y = self.point(x), self.point((-0.22, 0.27, 0.36))
        self.around = self.place(self.x), self.place(self.y)
        direction = direction or mi.warp.square_to_uniform_sphere(self.random.next_2d())
        numbers = segments.draw(self.random, self.media)
        ray = self.x.spawn_ray(mi.Vector3f(direction) + dr.zeros(mi.Vector3f, self.LANES))
        trace, medium = segments.next_surface(self.scene), self.around[0].medium
        self.base = segments.fly(self.media, trace, ray, medium, self.channel, numbers, active=self.YES)
        self.end, self.direction = media.vertex(self.base.ray, self.base.hit, self.base.place), ray.d

    def point(self, p):
        """A vertex in the air there."""
        si = dr.zeros(mi.SurfaceInteraction3f, self.LANES)
        si.p, si.t = mi.Point3f(*p) + dr.zeros(mi.Point3f, self.LANES), mi.Float(1)
        return si

    def place(self, x):
        """In the medium that a way from the camera leads to."""
        camera = self.point((0.2, 0.3, 2.2))
        ray, reach = camera.spawn_ray_to(x.p), dr.norm(x.p - camera.p)
        trace, medium = segments.next_surface(self.scene), mi.MediumPtr(self.scene.sensors()[0].get_medium())
        crossed = segments.cross(self.media.passes, trace, ray, medium, reach, active=self.YES, target=None)
        return Place(crossed[-1], self.YES)

    def reconnect(self, y, place, base):
        direction = dr.select(self.end.is_valid(), dr.normalize(self.end.p - y.p), self.direction)
        ray = dr.select(self.end.is_valid(), y.spawn_ray_to(self.end.p), y.spawn_ray(direction))
        of_base = {"x1": self.end, "base": base, "channel": self.channel, "active": self.YES}
        T, T_c, blocked = segments.reconnect(self.scene, self.media, y, place, ray, **of_base)
        return np.array(T).T, np.array(T_c), np.array(blocked)


@pytest.mark.parametrize("scene", [haze, colours, nested, smoke, coloured_smoke])
def test_a_segment_shifted_and_back_is_itself(renderer, scene):
    """Shifted to its own vertex too, with null collisions that are made anew. There and back, r(T(x)) r(x) = 1."""
    ways = Ways(scene)
    T, T_c, blocked = ways.reconnect(ways.x, ways.around[0], ways.base)
    assert blocked.mean() < 1e-3
    weight = np.array(ways.base.weight).T
    assert not ways.media.grids or np.array(ways.base.nulls.n).mean() > 0.3
    assert (np.abs(T_c - 1) < 2e-3)[~blocked].mean() > 0.999
    assert (np.abs(T - weight) < 2e-3 * np.abs(weight).max())[~blocked].mean() > 0.999
    if ways.media.grids:
        return
    _, T_c, blocked = ways.reconnect(ways.y, ways.around[1], ways.base)
    assert np.mean(~blocked) > 0.5 and np.std(np.log(T_c[~blocked])) > 0.02
    shifted = replace(ways.base, τ_c=ways.base.τ_c - mi.Float(np.log(T_c)))
    _, back, also_blocked = ways.reconnect(ways.x, ways.around[0], shifted)
    assert np.mean(also_blocked[~blocked]) < 1e-3
    assert (np.abs(T_c * back - 1) < 2e-3)[~blocked].mean() > 0.999


def test_segments_to_a_surface_behind_a_boundary_are_not_blocked_by_it(renderer):
    """Rays are displaced behind boundaries: nearly all of these were, and ``dy`` was off by 1 % of the light."""
    ways = Ways(hovering, x=(-0.3, -0.85, 0.3))
    *_, blocked = ways.reconnect(ways.x, ways.around[0], ways.base)
    floor = np.array(ways.end.is_valid() & (ways.end.p.y < -0.999))
    assert floor.mean() > 0.1
    assert blocked[floor].mean() < 1e-3


@pytest.mark.parametrize("scene", [nested, smoke, coloured_smoke])
def test_shifted_segments_carry_what_comes_through(renderer, scene):
    """All base segments that reach the same point, shifted, make the transmittance of the other way to it."""
    ways = Ways(scene, direction=(0.05, -0.6, -0.4))
    arrives = ~np.array(ways.base.place.scatters)
    assert 0.02 < arrives.mean() < 0.95
    T, _, blocked = ways.reconnect(ways.y, ways.around[1], ways.base)
    assert not blocked[arrives].any()
    shifted = np.where(arrives[:, None], T, 0)
    target = mi.Point3f(*(float(c[int(np.argmax(arrives))]) for c in np.array(ways.end.p)))
    drawn = {"channel": ways.channel, "key": ways.random.next_key(), "active": ways.YES}
    through = segments.transmittance(ways.scene, ways.media, ways.y, ways.around[1], target, **drawn)
    through = np.array(through).T + np.zeros_like(shifted)
    error = np.sqrt((shifted.var(axis=0) + through.var(axis=0)) / len(shifted))
    difference = shifted.mean(axis=0) - through.mean(axis=0)
    assert (np.abs(difference) < 4 * error + 1e-3 * through.mean(axis=0)).all(), (difference, error)
    # It is not what comes through on the base path's way.
    weights = np.where(arrives[:, None], np.array(ways.base.weight).T, 0)
    assert (np.abs(weights.mean(axis=0) - through.mean(axis=0)) > 4 * error).any()
