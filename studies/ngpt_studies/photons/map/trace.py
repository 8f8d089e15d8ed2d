"""Photon maps as ``ppm`` and ``bre`` have them, with what copies of photons and beams need of the light paths.

The photons are the same, bit by bit, and lie in the same places. Each vertex also knows its predecessor, and what the
ray from there has met. Edges of paths are kept where they are asked for. Places that a path does not need stay empty.
Their edges have the length 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.frozen import call
from data_gen.paths.light_ends import LightRay, World
from data_gen.paths.segments import next_surface
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.paths.walk import UNLIMITED
from data_gen.samplers.photons.map import trace as trace_of_photons
from data_gen.samplers.photons.map.trace import PATH_BYTES, VERTICES_PER_PATH, begun, empty_map, event, lives
from data_gen.samplers.photons.map.vertices import at, put
from ngpt_studies.photons.map.vertices import vertices_class

# Bytes of a vertex: 22 words of a record, as much again in the map before, and 9 words of a grid that is made.
VERTEX_BYTES = (22 + 22 + 9) * 4
# And bytes of an edge, twice
EDGE_BYTES = 12 * 4 * 2
# Bytes that a map takes for each light path.
MAP_BYTES = VERTICES_PER_PATH * VERTEX_BYTES + PATH_BYTES


@dataclass
class Paths(trace_of_photons.Paths):
    """The state of light paths at the start of their next edge, with the vertex there."""

    density: mi.Float  # with which the ray's direction was sampled; infinite by a mirror or alike; 0 of a first edge
    survival: mi.Float  # the probability to have survived Russian roulette there
    parent: mi.UInt32  # the place of the vertex there; of a first edge the number of the light path


def trace(
    world: World, random: mi.Sampler, max_depth: int, rr_depth: int, *, frozen: Callable = call, edges: bool = False
) -> tuple[LightRay, Iterator[Any]]:
    """One light path for each lane of ``random``, of at most ``max_depth`` edges, as maps of vertices.

    Light is gathered at materials that are connectable, and within the media of the world's fog. A map has
    VERTICES_PER_PATH places for each path. Further maps hold only the paths that go on, and begin with their last
    vertex, as parent. ``frozen`` calls the functions that make kernels; with ``edges`` maps have those, too. Returns
    the light's end of all paths, and the maps.
    """
    start, channel, medium, numbers = frozen(begun, world, random)
    dr.eval(start, channel, medium, numbers)
    n, power = dr.width(start.ray.d), dr.max(start.β)
    most, rr = dr.opaque(mi.UInt32, min(max(max_depth, 0), UNLIMITED)), dr.opaque(mi.UInt32, rr_depth)
    bounce = dr.ones(mi.UInt32, n)
    paths = Paths(
        ray=mi.Ray3f(start.ray.o, start.ray.d),
        β=start.β,
        brightest=dr.rcp(power),
        density=dr.zeros(mi.Float, n),
        survival=dr.ones(mi.Float, n),
        parent=dr.arange(mi.UInt32, n),
        bounce=bounce,
        alive=(power > 0) & (bounce <= most),
        channel=channel,
        medium=medium,
    )
    return start, _maps(world, paths, type(random)(numbers), (most, rr), frozen, edges)


def _maps(world: World, paths: Paths, random, depths: tuple, frozen: Callable, edges: bool) -> Iterator[Any]:
    """Yields map after map while paths are alive, each with the living paths."""
    kind = _vertices_of(world, edges)
    map_before = None
    while dr.width(lanes := dr.compress(paths.alive)):
        paths, random = at(paths, lanes), random.at(lanes)
        dr.eval(paths)
        random.schedule_state()
        photons, place, end = empty_map(kind, dr.width(lanes), VERTICES_PER_PATH)
        photons.t = dr.zeros(mi.Float, len(photons))
        if edges:
            photons.bounce = dr.zeros(mi.UInt32, len(photons))
        if map_before is not None:
            # A vertex that was gathered in the map before is not gathered again.
            vertex = at(map_before, paths.parent)
            vertex.depth = dr.zeros(mi.UInt32, len(vertex))
            if edges:
                vertex.bounce = vertex.depth
            put(photons, vertex, place, True)
            paths.parent, place = place, place + 1
        paths, numbers, photons = frozen(_walk, world, paths, random, depths, photons, (place, end))
        dr.eval(paths, numbers, photons)
        random = type(random)(numbers)
        map_before = photons
        yield photons


def _vertices_of(world: World, edges: bool) -> type:
    grids = world.fog is not None and world.fog.media.grids
    return vertices_class(mi.variant(), world.fog is not None, grids, edges)


@dr.syntax
def _walk(world: World, paths: Paths, random, depths: tuple, photons, places: tuple) -> tuple:
    """Enters vertices at each path's ``places`` (from, to); paths that are alive then have more of them.

    ``depths``: the most edges of a path, and the edge from which on Russian roulette is played.
    """
    scene, fog, receives = world.scene, world.fog, world.materials.connectable
    (max_depth, rr_depth), kind = depths, _vertices_of(world, edges=False)
    keeps_edges, random = hasattr(photons, "bounce"), random.clone()
    place, end = places  # of the vertex to come, and behind the last
    # What ``Paths`` says, of the edge to come
    ray, β, density, survival = mi.Ray3f(paths.ray), paths.β, paths.density, paths.survival
    parent, bounce, alive = mi.UInt32(paths.parent), mi.UInt32(paths.bounce), mi.Bool(paths.alive)
    channel, medium, brightest = paths.channel, paths.medium, paths.brightest
    while dr.hint(alive & (place < end), label="light paths"):
        # ------------------ The edge: what is at its end ------------------
        if dr.hint(fog is not None and keeps_edges, mode="scalar"):
            edge = {"o": ray.o, "e": ray.d, "power": β, "begins": medium, "colour": channel, "bounce": bounce}
            _enter(photons, edge | {"density": density, "survival": survival, "parent": parent}, place, alive)
        if dr.hint(fog is not None, mode="scalar"):
            segment, si = fog.fly(next_surface(scene), ray, medium, channel, random, alive)
            hit, where, β = segment.hit, segment.place, β * segment.weight
            exists, scatters = alive & si.is_valid() & (dr.max(β) > 0), where.scatters
            around, nulls = {"medium": where.medium, "channel": channel}, segment.nulls
            if dr.hint(nulls is not None, mode="scalar"):
                around |= {"key": nulls.key, "nulls": nulls.n, "N_c": nulls.N_c}
            if dr.hint(nulls is not None and keeps_edges, mode="scalar"):
                # Also for edges that lead to nothing
                _enter(photons, {"key": nulls.key, "nulls": nulls.n}, place, alive)
        else:
            hit = scene.ray_intersect_preliminary(ray, active=alive)
            si = hit.compute_surface_interaction(ray, active=alive)
            where, exists, scatters, around = None, alive & si.is_valid(), mi.Bool(False), {}

        # ---------------- The vertex, as it is in the map -----------------
        vertex = kind(
            p=si.p,
            n=si.n,
            d=ray.d,
            β=β,
            density=density,
            survival=survival,
            depth=dr.select(receives(si.bsdf()) | scatters, bounce, 0),
            parent=parent,
            t=hit.t,
            prim_uv=hit.prim_uv,
            prim_index=hit.prim_index,
            shape=hit.shape,
            instance=hit.instance,
            **around,
        )
        put(photons, vertex, place, exists)
        parent, place = dr.select(exists, place, parent), place + 1

        # ---------------- The direction of the next edge ------------------
        sample, f_p, u_survival = event(si, where, random, exists)
        β = β * f_p
        density = dr.select(event_kind(sample.sampled_type) == SMOOTH, sample.pdf, dr.inf)
        ray = si.spawn_ray(si.to_world(sample.wo))
        if dr.hint(fog is not None, mode="scalar"):
            medium = where.toward(si, ray.d)

        # ------------------ Whether the path goes on ----------------------
        alive, survival = lives(sample, β, brightest, u_survival, exists, bounce >= rr_depth)
        β = β / survival
        bounce += 1
        alive &= bounce <= max_depth
    ray = mi.Ray3f(ray.o, ray.d)
    on = Paths(ray, β, brightest, bounce, alive, channel, medium, density, survival, parent)
    return on, random.state, photons


def _enter(photons, values: dict, place: mi.UInt32, active) -> None:
    for name, value in values.items():
        dr.scatter(getattr(photons, name), value, place, active)
