"""Light paths as a map of vertices: traced bounce by bounce, one kernel each, all paths side by side.

Paths that are left are moved together after each bounce, in their order. So vertices lie in the map by bounce, then by
path: the same seed gives the same map. (Slots handed out by a counter would come in the order of threads.)

In media, vertices are where light scatters, too. Their normal is 0, and their power that which is scattered there: the
sum of it over a volume is σs times the light that goes through, so a camera path brings its transmittance alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.paths.segments import next_surface
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.samplers.bdpt.lights import LightEnds, LightRay
from data_gen.samplers.bdpt.vertex import IMPORTANCE, context, light_sampled

if TYPE_CHECKING:
    from data_gen.samplers.photons.fog import Fog

# Vertices of a map, for each light path of it. Paths that have more of them go on in another map.
VERTICES_PER_PATH = 8
# Bytes of a vertex: 22 words of a record, as much again while levels are joined, and 9 words of a grid that is made.
VERTEX_BYTES = (22 + 22 + 9) * 4
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
        """23 words a vertex."""

        medium: mi.MediumPtr  # around it

    return VerticesInMedia


def trace(
    scene: mi.Scene,
    lights: LightEnds,
    random: mi.Sampler,
    receives: Callable[[mi.BSDFPtr], mi.Bool],
    max_depth: int,
    rr_depth: int,
    fog: Fog | None = None,
) -> tuple[LightRay, Iterator[Any]]:
    """One light path for each lane of ``random``, of at most ``max_depth`` edges, as maps of vertices.

    Light is gathered at materials that it ``receives``, and within the media of ``fog``. A map has at most
    VERTICES_PER_PATH vertices for each path, and those of the bounce before its first one once more, as parents.
    Returns the light's end of all paths, and the maps.
    """
    start = lights.sample(scene, random, mi.Float(0), dr.zeros(mi.Ray3f).wavelengths)
    within = (media.choose_channel(random.next_1d()), fog.around(scene, start.ray.o)) if fog else ()
    dr.eval(start, within)
    random.schedule_state()
    return start, _maps(scene, start, random, receives, max_depth, rr_depth, fog, within)


def _maps(scene, start: LightRay, random, receives, max_depth: int, rr_depth: int, fog, within) -> Iterator[Any]:
    paths = dr.width(start.ray.d)
    room = paths * VERTICES_PER_PATH
    ray, β, brightest = start.ray, start.β, dr.rcp(dr.max(start.β))
    density, survival, parent = dr.zeros(mi.Float, paths), dr.ones(mi.Float, paths), dr.arange(mi.UInt32, paths)
    lanes = dr.compress(dr.max(β) > 0)
    levels: list = []
    size, bounce = 0, 1
    while dr.width(lanes) and bounce <= max_depth:
        ray = mi.Ray3f(dr.gather(mi.Point3f, ray.o, lanes), dr.gather(mi.Vector3f, ray.d, lanes))
        β, brightest, density, survival, parent = (
            dr.gather(type(x), x, lanes) for x in (β, brightest, density, survival, parent)
        )
        random = random.at(lanes)
        if fog:
            channel, medium = (dr.gather(type(x), x, lanes) for x in within)
            segment, si = fog.fly(next_surface(scene), ray, medium, channel, random, mi.Bool(True))
            hit, place, β = segment.hit, segment.place, β * segment.weight
            exists, scatters, around = si.is_valid() & (dr.max(β) > 0), place.scatters, (place.medium,)
        else:
            hit = scene.ray_intersect_preliminary(ray)
            si = hit.compute_surface_interaction(ray)
            exists, scatters, around = si.is_valid(), mi.Bool(False), ()
        bsdf = si.bsdf()
        depth = dr.select(receives(bsdf) | scatters, dr.opaque(mi.UInt32, bounce), 0)
        row = dr.prefix_sum(dr.select(exists, mi.UInt32(1), 0))
        level = (vertices_in_media_class if fog else vertices_class)(mi.variant())(
            *(si.p, si.n, ray.d, β, density, survival, depth, parent, hit.t, hit.prim_uv, hit.prim_index),
            *(hit.shape, hit.instance, *around),
        )
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(IMPORTANCE), si, u_lobe, u_direction, exists & ~scatters)
        f_p, _ = light_sampled(si, bsdf, sample, f_p, exists & (sample.pdf > 0))
        if fog:
            sample, f_p = media.scattered(si, place, u_lobe, u_direction, sample, f_p)
        β = β * f_p
        # By what is left of the light that the path began with
        survival = dr.ones(mi.Float, dr.width(lanes))
        if bounce >= rr_depth:
            survival = dr.fmin(dr.max(β) * brightest, 0.95)
        goes_on = exists & (sample.pdf > 0) & (dr.max(β) > 0) & dr.isfinite(dr.sum(β)) & (u_survival < survival)
        β, density = β / survival, dr.select(event_kind(sample.sampled_type) == SMOOTH, sample.pdf, dr.inf)
        ray = si.spawn_ray(si.to_world(sample.wo))
        if fog:
            within = channel, place.toward(si, ray.d)
        random.schedule_state()
        dr.eval(level, exists, goes_on, row, β, density, survival, ray, within)
        level = _at(level, dr.compress(exists))
        if not len(level):
            break  # all that was left has escaped
        dr.eval(level)
        if levels and size + len(level) > room:
            yield _joined(levels)
            # What has been gathered of it is not gathered again.
            parents = replace(levels[-1], depth=dr.zeros(mi.UInt32, len(levels[-1])))
            level.parent = level.parent - dr.opaque(mi.UInt32, size - len(parents))
            levels, size = [parents], len(parents)
        levels.append(level)
        parent = row + dr.opaque(mi.UInt32, size)
        size += len(level)
        lanes = dr.compress(goes_on)
        bounce += 1
    if levels:
        yield _joined(levels)


def vertex_of(photons, index: mi.UInt32, active=True) -> mi.SurfaceInteraction3f:
    """A vertex of a map, as the light path has come to it."""
    fields_of_hit = ("t", "prim_uv", "prim_index", "shape", "instance")
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(index))
    for name in fields_of_hit:
        value = getattr(photons, name)
        setattr(hit, name, dr.gather(type(value), value, index, active))
    # Not told by any other field: without it the vertex would be void.
    hit.valid = mi.Bool(active)
    p, d = dr.gather(mi.Point3f, photons.p, index, active), dr.gather(mi.Vector3f, photons.d, index, active)
    return hit.compute_surface_interaction(mi.Ray3f(p - d * hit.t, d), active=active)


def _at(vertices, index: mi.UInt32):
    """The vertices of these places alone."""
    values = (getattr(vertices, f.name) for f in fields(vertices))
    return type(vertices)(*(dr.gather(type(value), value, index) for value in values))


def _joined(levels: list):
    """One map of all levels."""
    if len(levels) == 1:
        return levels[0]
    kind, total, first = type(levels[0]), sum(map(len, levels)), 0
    whole = kind(*(dr.zeros(type(getattr(levels[0], f.name)), total) for f in fields(kind)))
    for level in levels:
        place = dr.arange(mi.UInt32, len(level)) + dr.opaque(mi.UInt32, first)
        for f in fields(kind):
            dr.scatter(getattr(whole, f.name), getattr(level, f.name), place)
        first += len(level)
    dr.eval(whole)
    return whole
