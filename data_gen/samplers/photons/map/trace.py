"""Traces light paths into a map of vertices: all paths in one kernel, each with its own places in the map.

So vertices are ordered by path, then by bounce, and the same seed gives the same map. (If paths took their places from
a shared counter, the order would depend on threads.) Places that a path does not need stay empty, and have depth 0.

Points where light scatters in media are vertices, too. Their normal is 0, and their power is the scattered power. The
sum of this power over a volume is the scattering coefficient σs times the light that goes through. So a camera path
does not multiply it by σs again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, get_type_hints

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.paths.frozen import call
from data_gen.paths.light_ends import World
from data_gen.paths.segments import next_surface
from data_gen.paths.walk import UNLIMITED, roulette
from data_gen.samplers.bdpt.vertex import IMPORTANCE, context, light_sampled
from data_gen.samplers.photons.map.vertices import at, put, vertices_class

# Places of a map for each of its light paths; at least 2. Paths with more vertices go on in another map.
VERTICES_PER_PATH = 8
# Bytes of a vertex: 13 words of a record, 13 more in the map before, and 9 words while the grid is made.
VERTEX_BYTES = (13 + 13 + 9) * 4
# Other bytes of a light path: rays, throughput and random numbers, twice, and its start.
PATH_BYTES = 512
# Bytes of a map for each light path.
MAP_BYTES = VERTICES_PER_PATH * VERTEX_BYTES + PATH_BYTES


@dataclass
class Paths:
    """The state of light paths at the start of their next edge."""

    ray: mi.Ray3f  # along that edge
    β: mi.Spectrum  # power at its start, times the number of light paths
    brightest: mi.Float  # 1 / the largest channel of their initial power
    bounce: mi.UInt32  # the number of the edge, from 1
    alive: mi.Bool
    channel: mi.UInt32 | None  # the colour by which distances are sampled; None in scenes without media
    medium: mi.MediumPtr | None  # the medium at the start of the edge


def trace(world: World, random: mi.Sampler, max_depth: int, rr_depth: int, frozen: Callable = call) -> Iterator[Any]:
    """Yields maps of the vertices of light paths: one path for each lane of ``random``, of at most ``max_depth`` edges.

    Light is gathered at connectable materials, and in the media of the world's fog. A map has VERTICES_PER_PATH places
    for each path. Further maps hold only the paths that go on. ``frozen`` calls the functions that make kernels.
    """
    start, channel, medium, numbers = frozen(begun, world, random)
    dr.eval(start, channel, medium, numbers)
    power = dr.max(start.β)
    depths = dr.opaque(mi.UInt32, min(max(max_depth, 0), UNLIMITED)), dr.opaque(mi.UInt32, rr_depth)
    bounce = dr.ones(mi.UInt32, dr.width(start.ray.d))
    ray, alive = mi.Ray3f(start.ray.o, start.ray.d), (power > 0) & (bounce <= depths[0])
    paths, random = Paths(ray, start.β, dr.rcp(power), bounce, alive, channel, medium), type(random)(numbers)
    kind, used = vertices_class(mi.variant(), world.fog is not None), 0
    while dr.width(lanes := dr.compress(paths.alive)):
        paths, random = at(paths, lanes), random.at(lanes)
        dr.eval(paths)
        random.schedule_state()
        photons, place, end = empty_map(kind, dr.width(lanes), VERTICES_PER_PATH)
        paths, numbers, photons = frozen(_walk, world, paths, random, depths, photons, (place + used, end))
        dr.eval(paths, numbers, photons)
        random = type(random)(numbers)
        # In further maps the first place of each path stays empty. So sums over photons are grouped, and rounded, in
        # the same way as in earlier versions.
        used = 1
        yield photons


def empty_map(kind: type, paths: int, places: int) -> tuple[Any, mi.UInt32, mi.UInt32]:
    """An empty map of vertices of this ``kind``, with ``places`` places for each light path.

    Returns the map, the first place of each path, and the place behind its last.
    """
    n = paths * places
    photons = kind(*(dr.empty(t, n) for t in get_type_hints(kind).values()))
    photons.depth = dr.zeros(mi.UInt32, n)
    place = dr.arange(mi.UInt32, paths) * dr.opaque(mi.UInt32, places)
    return photons, place, place + dr.opaque(mi.UInt32, places)


def begun(world: World, random) -> tuple:
    """The starts of light paths, their colours and media in scenes with fog, and the state of their random numbers."""
    random, channel, medium = random.clone(), None, None
    start = world.lights.sample(world.scene, random, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths)
    if world.fog:
        channel, medium = media.choose_channel(random.next_1d()), world.fog.around(world.scene, start.ray.o)
    return start, channel, medium, random.state


@dr.syntax
def _walk(world: World, paths: Paths, random, depths: tuple, photons, places: tuple) -> tuple:
    """Enters vertices at each path's ``places`` (from, to). Paths that are still alive afterwards have more vertices.

    ``depths`` is the largest number of edges of a path, and the first edge with Russian roulette.
    """
    scene, fog, receives = world.scene, world.fog, world.materials.connectable
    (max_depth, rr_depth), kind, random = depths, type(photons), random.clone()
    place, end = places  # the place of the next vertex, and that behind the last
    # The fields of ``Paths``, for the next edge
    ray, β, brightest = mi.Ray3f(paths.ray), paths.β, paths.brightest
    bounce, alive, channel, medium = mi.UInt32(paths.bounce), mi.Bool(paths.alive), paths.channel, paths.medium
    while dr.hint(alive & (place < end), label="light paths"):
        # ------------------ The edge, and the vertex at its end -----------
        if dr.hint(fog is not None, mode="scalar"):
            segment, si = fog.fly(next_surface(scene), ray, medium, channel, random, alive)
            where, β = segment.place, β * segment.weight
            exists, scatters = alive & si.is_valid() & (dr.max(β) > 0), where.scatters
            around = {"medium": where.medium}
        else:
            hit = scene.ray_intersect_preliminary(ray, active=alive)
            si = hit.compute_surface_interaction(ray, active=alive)
            where, exists, scatters, around = None, alive & si.is_valid(), mi.Bool(False), {}

        # ------------------------ Into the map ----------------------------
        depth = dr.select(receives(si.bsdf()) | scatters, bounce, 0)
        put(photons, kind(p=si.p, n=si.n, d=ray.d, β=β, depth=depth, **around), place, exists)
        place += 1

        # ------------- The next edge, and whether there is one ------------
        sample, f_p, u_survival = event(si, where, random, exists)
        β = β * f_p
        ray = si.spawn_ray(si.to_world(sample.wo))
        if dr.hint(fog is not None, mode="scalar"):
            medium = where.toward(si, ray.d)
        alive, survival = lives(sample, β, brightest, u_survival, exists, bounce >= rr_depth)
        β = β / survival
        bounce += 1
        alive &= bounce <= max_depth
    return Paths(mi.Ray3f(ray.o, ray.d), β, brightest, bounce, alive, channel, medium), random.state, photons


def event(si: mi.SurfaceInteraction3f, where: media.Place | None, random, exists: mi.Bool) -> tuple:
    """Samples how light paths scatter at vertices: the sample, f / p, and a random number for Russian roulette."""
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    bsdf, at_surface = si.bsdf(), exists if where is None else exists & ~where.scatters
    sample, f_p = bsdf.sample(context(IMPORTANCE), si, u_lobe, u_direction, at_surface)
    f_p, _ = light_sampled(si, bsdf, sample, f_p, exists & (sample.pdf > 0))
    if where is not None:
        sample, f_p = media.scattered(si, where, u_lobe, u_direction, sample, f_p)
    return sample, f_p, u_survival


def lives(sample, β: mi.Spectrum, brightest: mi.Float, u: mi.Float, exists: mi.Bool, plays: mi.Bool) -> tuple:
    """Returns which light paths survive an event, and their probability to survive. β is the power after the event.

    Where Russian roulette ``plays``, it depends on the share of the path's initial light that is left.
    """
    survival = roulette(dr.max(β) * brightest, plays)
    return exists & (sample.pdf > 0) & (dr.max(β) > 0) & dr.isfinite(dr.sum(β)) & (u < survival), survival
