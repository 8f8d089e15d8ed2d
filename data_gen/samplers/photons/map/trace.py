"""Light paths as a map of vertices: all paths side by side, in one kernel, each with places of its own in the map.

So vertices lie in the map by path, then by bounce: the same seed gives the same map. (Places handed out by a counter
would come in the order of threads.) Places that a path does not need stay empty, their edges have the length 0.

In media, vertices are where light scatters, too. Their normal is 0, and their power that which is scattered there: the
sum of it over a volume is σs times the light that goes through, so a camera path brings its transmittance alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, get_type_hints

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.paths.frozen import call
from data_gen.paths.light_ends import LightEnds, LightRay
from data_gen.paths.segments import next_surface
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.samplers.bdpt.vertex import IMPORTANCE, context, light_sampled

if TYPE_CHECKING:
    from data_gen.samplers.photons.map.fog import Fog

# Vertices of a map, for each light path of it; at least 2. Paths that have more of them go on in another map.
VERTICES_PER_PATH = 8
# Bytes of a vertex: 22 words of a record, as much again in the map before, and 9 words of a grid that is made.
VERTEX_BYTES = (22 + 22 + 9) * 4
# And those of an edge, twice
EDGE_BYTES = 12 * 4 * 2
# Bytes of a light path beside that: rays, throughput and random numbers, twice, and its start.
PATH_BYTES = 512
# Bytes that a map takes for each light path.
MAP_BYTES = VERTICES_PER_PATH * VERTEX_BYTES + PATH_BYTES


@cache
def vertices_class(variant: str) -> type:
    """Of a map; Mitsuba's types belong to a variant."""

    @dataclass
    class Vertices:
        """Vertices of light paths, an array of each field: 22 words a vertex."""

        p: mi.Point3f
        n: mi.Normal3f  # geometric
        d: mi.Vector3f  # of the light that arrives
        β: mi.Spectrum  # its power, times the number of light paths
        density: mi.Float  # with which d was sampled at the parent: infinite by a mirror or alike; 0 at a first vertex
        survival: mi.Float  # the probability to survive Russian roulette at the parent
        depth: mi.UInt32  # edges from the light; 0 where nothing is gathered: the vertex is a parent alone
        parent: mi.UInt32  # its place in the map; of a first vertex, the number of its light path
        t: mi.Float  # the length of the edge from there
        prim_uv: mi.Point2f
        prim_index: mi.UInt32
        shape: mi.ShapePtr
        instance: mi.ShapePtr

        def __len__(self) -> int:
            return dr.width(self.t)

    return Vertices


@cache
def vertices_in_media_class(variant: str) -> type:
    """The same of a scene with media."""

    @dataclass
    class VerticesInMedia(vertices_class(variant)):  # type: ignore[misc]
        """24 words a vertex."""

        medium: mi.MediumPtr  # around it
        channel: mi.UInt32  # the colour by which the light path samples its distances

    return VerticesInMedia


@cache
def vertices_in_grids_class(variant: str) -> type:
    """The same of a scene with media whose density varies."""

    @dataclass
    class VerticesInGrids(vertices_in_media_class(variant)):  # type: ignore[misc]
        """27 words a vertex; of the edge that leads there ``collisions.Collisions`` without M."""

        key: mi.UInt32
        nulls: mi.UInt32
        N_c: mi.Float

    return VerticesInGrids


def kind_of_vertices(fog: Fog | None) -> type:
    """What maps of a scene with those media hold, beside edges."""
    of_media = vertices_in_grids_class if fog and fog.media.grids else vertices_in_media_class
    return (of_media if fog else vertices_class)(mi.variant())


@cache
def vertices_and_edges_class(variant: str, grids: bool = False) -> type:
    """The same where the edges of light paths are kept, too."""

    @dataclass
    class VerticesAndEdges(  # type: ignore[misc]
        vertices_in_grids_class(variant) if grids else vertices_in_media_class(variant)
    ):
        """The edge that leads to a vertex, in the same place, or to nothing: 12 words more."""

        o: mi.Point3f  # where it begins
        e: mi.Vector3f  # its direction
        power: mi.Spectrum  # there, times the number of light paths
        begins: mi.MediumPtr  # there
        colour: mi.UInt32  # ``channel``
        bounce: mi.UInt32  # its number; 0 where there is none

    return VerticesAndEdges


@dataclass
class _Paths:
    """Light paths on their way, where their next edge begins."""

    ray: mi.Ray3f
    β: mi.Spectrum
    brightest: mi.Float  # one over what they began with
    density: mi.Float
    survival: mi.Float
    parent: mi.UInt32
    bounce: mi.UInt32  # the number of the edge
    alive: mi.Bool
    within: tuple  # their colour and their medium, of scenes with media


def trace(
    scene: mi.Scene,
    lights: LightEnds,
    random: mi.Sampler,
    receives: Callable[[mi.BSDFPtr], mi.Bool],
    max_depth: int,
    rr_depth: int,
    fog: Fog | None = None,
    frozen: Callable = call,
    edges: bool = False,
) -> tuple[LightRay, Iterator[Any]]:
    """One light path for each lane of ``random``, of at most ``max_depth`` edges, as maps of vertices.

    Light is gathered at materials that it ``receives``, and within the media of ``fog``. A map has VERTICES_PER_PATH
    places for each path; further maps are of those paths alone that go on, and begin with their last vertex, as parent.
    ``frozen`` calls the functions that make kernels; with ``edges`` maps have those, too. Returns the light's end of
    all paths, and the maps.
    """
    start, within, numbers = frozen(_start, scene, lights, random, fog, fixed=True)
    dr.eval(start, within, numbers)
    random = type(random)(numbers)
    n = dr.width(start.ray.d)
    paths = _Paths(
        *(mi.Ray3f(start.ray.o, start.ray.d), start.β, dr.rcp(dr.max(start.β))),
        *(dr.zeros(mi.Float, n), dr.ones(mi.Float, n), dr.arange(mi.UInt32, n)),
        *(dr.ones(mi.UInt32, n), dr.max(start.β) > 0, within),
    )
    depths = dr.opaque(mi.UInt32, min(max(max_depth, 0), 0xFFFFFFFF)), dr.opaque(mi.UInt32, rr_depth)
    paths.alive &= paths.bounce <= depths[0]
    return start, _maps(scene, paths, random, receives, depths, fog, frozen, edges)


def _start(scene, lights: LightEnds, random, fog) -> tuple:
    """Where light paths begin, what of media is known there, and their random numbers from then on."""
    random = random.clone()
    start = lights.sample(scene, random, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths)
    within = (media.choose_channel(random.next_1d()), fog.around(scene, start.ray.o)) if fog else ()
    return start, within, random.random


def _maps(scene, paths: _Paths, random, receives, depths: tuple, fog, frozen, edges: bool) -> Iterator[Any]:
    kind = vertices_and_edges_class(mi.variant(), fog.media.grids) if edges else kind_of_vertices(fog)
    map_before = None
    while dr.width(lanes := dr.compress(paths.alive)):
        paths, random = _at(paths, lanes), random.at(lanes)
        dr.eval(paths)
        random.schedule_state()
        n = dr.width(lanes) * VERTICES_PER_PATH
        photons = kind(*(dr.empty(t, n) for t in get_type_hints(kind).values()))
        photons.t, photons.depth = dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n)
        if edges:
            photons.bounce = dr.zeros(mi.UInt32, n)
        place = dr.arange(mi.UInt32, dr.width(lanes)) * dr.opaque(mi.UInt32, VERTICES_PER_PATH)
        end = place + dr.opaque(mi.UInt32, VERTICES_PER_PATH)
        if map_before is not None:
            # What has been gathered of it is not gathered again.
            vertex = _at(map_before, paths.parent)
            vertex.depth = dr.zeros(mi.UInt32, len(vertex))
            if edges:
                vertex.bounce = vertex.depth
            put(photons, vertex, place, True)
            paths.parent, place = place, place + 1
        paths, numbers, photons = frozen(_walk, scene, paths, random, receives, depths, fog, photons, place, end)
        dr.eval(paths, numbers, photons)
        random = type(random)(numbers)
        map_before = photons
        yield photons


@dr.syntax
def _walk(scene, paths: _Paths, random, receives, depths: tuple, fog, photons, place, end) -> tuple:
    """Enters vertices at each path's places, from ``place`` up to ``end``; paths still alive then have more of them."""
    random = random.clone()
    ray, β, density, survival = mi.Ray3f(paths.ray), paths.β, paths.density, paths.survival
    parent, bounce, alive, within = mi.UInt32(paths.parent), mi.UInt32(paths.bounce), mi.Bool(paths.alive), paths.within
    brightest, (max_depth, rr_depth) = paths.brightest, depths
    kind = kind_of_vertices(fog)
    while dr.hint(alive & (place < end), label="light paths"):
        if dr.hint(fog is not None, mode="scalar"):
            channel, medium = within
            if dr.hint(hasattr(photons, "bounce"), mode="scalar"):
                _begin(photons, place, alive, ray, β, medium, channel, bounce, density, survival, parent)
            segment, si = fog.fly(next_surface(scene), ray, medium, channel, random, alive)
            hit, where, β = segment.hit, segment.place, β * segment.weight
            exists, scatters = alive & si.is_valid() & (dr.max(β) > 0), where.scatters
            nulls = segment.nulls
            if dr.hint(nulls is not None and hasattr(photons, "bounce"), mode="scalar"):
                # Of edges that lead to nothing as well
                dr.scatter(photons.key, nulls.key, place, alive)
                dr.scatter(photons.nulls, nulls.n, place, alive)
            around = where.medium, channel, *((nulls.key, nulls.n, nulls.N_c) if nulls else ())
        else:
            hit = scene.ray_intersect_preliminary(ray, active=alive)
            si = hit.compute_surface_interaction(ray, active=alive)
            exists, scatters, around = alive & si.is_valid(), mi.Bool(False), ()
        bsdf = si.bsdf()
        depth = dr.select(receives(bsdf) | scatters, bounce, 0)
        vertex = kind(
            *(si.p, si.n, ray.d, β, density, survival, depth, parent, hit.t, hit.prim_uv, hit.prim_index),
            *(hit.shape, hit.instance, *around),
        )
        put(photons, vertex, place, exists)
        parent, place = dr.select(exists, place, parent), place + 1
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(IMPORTANCE), si, u_lobe, u_direction, exists & ~scatters)
        f_p, _ = light_sampled(si, bsdf, sample, f_p, exists & (sample.pdf > 0))
        if dr.hint(fog is not None, mode="scalar"):
            sample, f_p = media.scattered(si, where, u_lobe, u_direction, sample, f_p)
        β = β * f_p
        # By what is left of the light that the path began with
        survival = dr.select(bounce >= rr_depth, dr.fmin(dr.max(β) * brightest, 0.95), 1)
        alive = exists & (sample.pdf > 0) & (dr.max(β) > 0) & dr.isfinite(dr.sum(β)) & (u_survival < survival)
        β, density = β / survival, dr.select(event_kind(sample.sampled_type) == SMOOTH, sample.pdf, dr.inf)
        ray = si.spawn_ray(si.to_world(sample.wo))
        if dr.hint(fog is not None, mode="scalar"):
            within = channel, where.toward(si, ray.d)
        bounce += 1
        alive &= bounce <= max_depth
    return (
        _Paths(mi.Ray3f(ray.o, ray.d), β, brightest, density, survival, parent, bounce, alive, within),
        random.random,
        photons,
    )


def vertex_of(photons, index: mi.UInt32, active=True) -> mi.SurfaceInteraction3f:
    """A vertex of a map on a surface, as the light path has come to it."""
    ray, hit = _met(photons, index, active)
    return hit.compute_surface_interaction(ray, active=active)


def vertex_in_media_of(photons, index: mi.UInt32, active=True) -> tuple[mi.SurfaceInteraction3f, media.Place]:
    """A vertex of a map of a scene with media, and its place."""
    ray, hit = _met(photons, index, active)
    scatters = active & (dr.squared_norm(dr.gather(mi.Normal3f, photons.n, index, active)) == 0)
    place = media.Place(dr.gather(mi.MediumPtr, photons.medium, index, active), scatters)
    return media.vertex(ray, hit, place), place


def _met(photons, index: mi.UInt32, active) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
    """The last piece of the ray that led to a vertex, and what it met there."""
    fields_of_hit = ("t", "prim_uv", "prim_index", "shape", "instance")
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(index))
    for name in fields_of_hit:
        value = getattr(photons, name)
        setattr(hit, name, dr.gather(type(value), value, index, active))
    # Not told by any other field: without it the vertex would be void.
    hit.valid = mi.Bool(active)
    p, d = dr.gather(mi.Point3f, photons.p, index, active), dr.gather(mi.Vector3f, photons.d, index, active)
    return mi.Ray3f(p - d * hit.t, d), hit


def _begin(photons, place, active, ray, β, medium, channel, bounce, density, survival, parent) -> None:
    """Enters edges at these places of a map, with what is known of them before they lead anywhere."""
    edge = {"o": ray.o, "e": ray.d, "power": β, "begins": medium, "colour": channel, "bounce": bounce}
    for name, value in (edge | {"density": density, "survival": survival, "parent": parent}).items():
        dr.scatter(getattr(photons, name), value, place, active)


def put(photons, vertex, place: mi.UInt32, active) -> None:
    """Enters vertices at these places of a map."""
    for f in fields(vertex):
        dr.scatter(getattr(photons, f.name), getattr(vertex, f.name), place, active)


def _at(some, index: mi.UInt32):
    """The vertices, or the paths, of these places alone."""
    return type(some)(*(_gather(getattr(some, f.name), index) for f in fields(some)))


def _gather(value, index: mi.UInt32):
    return tuple(_gather(v, index) for v in value) if isinstance(value, tuple) else dr.gather(type(value), value, index)
