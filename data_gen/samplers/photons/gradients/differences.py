"""Gradient samples of gathered photons: of all pairs of a camera path and a photon near it, piece by piece, and summed.

What photons are near to, points on surfaces here, is a class that says where points are (``where``), what pairs bring
with the photon for its own copy (``of_pairs``), and by other copies (``of_copies``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import SHIFTS, GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightRay
from data_gen.paths.shift import gradient_weight
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.photons.gradients.camera import Level, Path
from data_gen.samplers.photons.gradients.copies import copy
from data_gen.samplers.photons.gradients.pairs import Pairs, Points, pieces
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.photon import is_near, light, photon_of
from data_gen.samplers.photons.passes import Passes, begin

# Levels are joined until they have so many paths for each camera sample.
LEVELS = 3
# Pairs of a point and a photon that are in memory together, for each camera sample; and the bytes of one.
PAIRS = 16
PAIR_BYTES = 192


@dataclass(init=False)
class Near:
    """The photons of a map where they are gathered on surfaces, and where their light paths start."""

    starts: LightRay
    photons: Any
    grid: Grid
    radius2: mi.Float
    K: mi.Float

    def __init__(self, starts: LightRay, photons, radius: float, paths: int):
        self.starts, self.photons = starts, photons
        on_surfaces = (photons.depth > 0) & (dr.squared_norm(photons.n) > 0)
        self.grid = Grid(photons.p, on_surfaces, radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * paths))

    def where(self, materials, base: Path) -> tuple[Points, mi.Bool]:
        """The vertices of base paths, and whether photons are gathered there."""
        x = base.vertex()
        return Points(mi.Point3f(x.p)), base.alive & x.is_valid() & materials.connectable(x.bsdf())

    def of_pairs(self, materials, pairs: Pairs, base: Path, offsets: list, longest: mi.UInt32) -> tuple:
        """Of each pair C, four Δ with the photon for its copy, and counts; and where a copy is to be looked for."""
        j = dr.gather(mi.UInt32, self.grid.index, pairs.place)
        photon = photon_of(self.photons, j)
        short = dr.gather(mi.UInt32, self.photons.depth, j) <= dr.gather(mi.UInt32, longest, pairs.point)
        direct = dr.isfinite(dr.gather(mi.Float, self.photons.density, j))
        x, β = point_of([base], None, pairs.point)
        gathered = short & is_near(photon, x, self.radius2)
        C = β * light(photon, x, x.bsdf(), gathered) * self.K
        lit = dr.max(C) > 0
        Δ, apart = [], []
        for offset in offsets:
            y, β1 = point_of([offset], None, pairs.point)
            receives = lit & dr.gather(mi.Bool, offset.alive, pairs.point)
            receives &= y.is_valid() & materials.connectable(y.bsdf())
            shared = receives & is_near(photon, y, self.radius2)
            C1 = β1 * light(photon, y, y.bsdf(), shared) * self.K
            Δ.append(difference(C, C1, mi.Float(1)))
            apart.append(receives & ~shared & direct)
        return [C, *Δ, mi.Point2f(dr.select(lit, len(SHIFTS), 0), 0)], apart

    def of_copies(
        self, scene, lights, materials, fog, pairs: Pairs, some: mi.UInt32, which: mi.UInt32, base, offsets: list, C
    ) -> mi.Spectrum:
        """Δ by the shift of number ``which`` of ``some`` pairs, whose photons are near to the base path alone."""
        point, place = (dr.gather(mi.UInt32, index, some) for index in (pairs.point, pairs.place))
        j, C = dr.gather(mi.UInt32, self.grid.index, place), dr.gather(mi.Spectrum, C, some)
        x, _ = point_of([base], None, point)
        y, β = point_of(offsets, which, point)
        photon, everywhere = photon_of(self.photons, j), dr.full(mi.Bool, True, dr.width(j))
        ends = scene, lights, materials.connectable, self.starts, self.photons
        moved, r, good = copy(*ends, j, photon, x, y, self.radius2, everywhere, fog)
        return difference(C, β * light(moved, y, y.bsdf(), good) * self.K, r)


def gradient_pass(integrator, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
    """One photon map, and one camera path and its four shifts for each camera sample, of which a pixel has one.

    The ``integrator`` says what is gathered of a map (``gathered``), how camera paths go on (``levels``), what emission
    they meet (``met``), and what is near to them (``parts``): see ``GPM``.
    """
    ray, importance, random, keys, values = begin(passes, camera)
    shifted = [camera.rays(shift) for shift in SHIFTS.values()]
    rays = [(mi.Ray3f(ray), importance, mi.Bool(True)), *((mi.Ray3f(r), *more) for r, *more in shifted)]
    dr.eval(values, rays)
    n = dr.width(camera.pixel)
    # The primal, the four Δ, and how many photons were gathered and had no copy
    sums = [dr.zeros(mi.Spectrum, n) for _ in range(1 + len(SHIFTS))] + [dr.zeros(mi.Point2f, n)]
    Le = mi.Spectrum(0)
    for levels in groups(integrator.levels(passes, random, rays), LEVELS * n):
        for level in levels:
            Le = Le + integrator.met(passes, level, sums)
        lanes, level = [level.lanes for level in levels], joined(passes, levels)
        del levels
        together = [dr.zeros(type(total), dr.width(level.lanes)) for total in sums]
        for near in maps_of(integrator, passes, keys, camera.first):
            for part in integrator.parts(passes, near, level, integrator.pairs * n):
                together = [total + value for total, value in zip(together, part, strict=True)]
                dr.eval(together)
        low = 0
        for some in lanes:
            places = dr.arange(mi.UInt32, dr.width(some)) + dr.opaque(mi.UInt32, low)
            add_to(sums, some, [dr.gather(type(total), total, places) for total in together])
            low += dr.width(some)
    L, *Δ, counts = sums
    values |= {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
    if integrator.diagnostics:
        values["shift_failures"] = counts.y / dr.fmax(counts.x, 1)
    film.put_all(values)
    for name, difference, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
        film.put(name, to_rgb(difference, ray.wavelengths), inside)


def groups(levels: Iterator[Level], most: int) -> Iterator[list[Level]]:
    """The levels, as many at a time as have at most so many paths: a kernel for few takes as long as one for many."""
    group: list[Level] = []
    for level in levels:
        if group and sum(dr.width(one.lanes) for one in (*group, level)) > most:
            yield group
            group = []
        group.append(level)
    yield group


def joined(passes: Passes, levels: list[Level]) -> Level:
    """All paths of some levels, one level after another."""
    if len(levels) == 1:
        return levels[0]
    n, low = sum(dr.width(level.lanes) for level in levels), 0
    first = levels[0]
    paths = [dr.empty(type(path), n) for path in (first.base, *first.offsets)]
    all_of_it = [dr.empty(mi.UInt32, n), dr.empty(mi.UInt32, n), paths]
    for level in levels:
        values = [level.lanes, level.depth, [level.base, *level.offsets]]
        all_of_it = passes.frozen(entered, all_of_it, values, dr.opaque(mi.UInt32, low))
        dr.eval(all_of_it)
        low += dr.width(level.lanes)
    lanes, depth, (base, *offsets) = all_of_it
    return replace(first, lanes=lanes, depth=depth, base=base, offsets=offsets)


def entered(all_of_it: list, values: list, low: mi.UInt32) -> list:
    """``all_of_it``, a tree of arrays, with that of ``values`` from place ``low`` on."""
    dr.scatter(all_of_it, values, low + dr.arange(mi.UInt32, dr.width(values[0])))
    return all_of_it


def maps_of(integrator, passes: Passes, keys, number: int) -> Iterator:
    """What is near in the photon maps of pass ``number``."""
    if passes.world.lights.emitters is not None and integrator.max_depth > 1:
        starts, maps = integrator.photon_maps(passes, keys)
        for photons in maps:
            yield from integrator.gathered(passes, starts, photons, number, integrator.photons * dr.width(keys[0]))


def differences(passes, near, base, offsets: list, longest: mi.UInt32, most: int) -> Iterator[list]:
    """Piece by piece of all pairs, the sums for each base path: L, four Δ, and counts of photons.

    ``longest``: edges that the light path of a photon may have, of each base path.
    """
    frozen, kind, ends = passes.frozen, type(near), (passes.world.scene, passes.world.lights, passes.world.materials)
    points, receives = frozen(kind.where, near, passes.world.materials, base)
    dr.eval(points, receives)
    for pairs in pieces(near.grid, points, near.radius2, receives, most, frozen):
        values, apart = frozen(kind.of_pairs, near, passes.world.materials, pairs, base, offsets, longest)
        dr.eval(values, apart)
        C, *Δ, counts = values
        places = [dr.compress(one) for one in apart]
        known = [k for k, some in enumerate(places) if dr.width(some)]
        if known:
            # All shifts in one kernel: to launch one takes longer than to run it, where images are small.
            some = dr.concat([places[k] for k in known])
            which = dr.concat([dr.full(mi.UInt32, k, dr.width(places[k])) for k in known])
            copied = frozen(kind.of_copies, near, *ends, passes.integrator.fog, pairs, some, which, base, offsets, C)
            for k, one in enumerate(Δ):
                dr.scatter(one, copied, some, which == k)
            dr.eval(Δ)
        sums = frozen(summed, pairs, C, Δ, counts)
        dr.eval(sums)
        yield sums


def summed(pairs: Pairs, C: mi.Spectrum, Δ: list, counts: mi.Point2f) -> list:
    """Of each point the sums of all over its pairs; pairs without a copy are counted."""
    failures = mi.Float(0)
    for one in Δ:
        failures += dr.select((counts.x > 0) & dr.all(one == -2 * C), 1, 0)
    return pairs.sums([C, *Δ, mi.Point2f(counts.x, failures)])


def point_of(paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum]:
    """A vertex of camera paths, and their throughput; of the path of number ``which``, if there is more than one."""
    o, d, hit, β = chosen(parts, paths, which, index)
    return hit.compute_surface_interaction(mi.Ray3f(o, d)), β


def chosen(parts, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> tuple:
    """``parts`` (path, index) of the path of number ``which``, if there is more than one."""
    found = parts(paths[0], index)
    for k, path in enumerate(paths[1:], 1):
        here = which == k
        found = tuple(dr.select(here, new, old) for new, old in zip(parts(path, index), found, strict=True))
    return found


def parts(path, index: mi.UInt32) -> tuple:
    """Origin, direction and hit of a path's ray, and its throughput."""
    o, d = dr.gather(mi.Point3f, path.ray.o, index), dr.gather(mi.Vector3f, path.ray.d, index)
    return o, d, dr.gather(mi.PreliminaryIntersection3f, path.hit, index), dr.gather(mi.Spectrum, path.β, index)


def difference(C: mi.Spectrum, C1: mi.Spectrum, r: mi.Float) -> mi.Spectrum:
    """Δ of a path and its copy. One that carries no light is none: black is black from either end, in all channels."""
    good = (dr.max(C1) > 0) & dr.isfinite(dr.sum(C1)) & dr.isfinite(r)
    return dr.select(dr.max(C) > 0, gradient_weight(r, good) * (dr.select(good, C1, 0) - C), 0)


def emitted(scene, base: Path, offsets: list) -> list:
    """Emission that base paths meet, and its four Δ."""
    C = base.emission(scene)
    return [C, *(gradient_weight(mi.Float(1), path.alive) * (path.emission(scene) - C) for path in offsets)]


def add_to(sums: list, lanes: mi.UInt32, parts: list) -> None:
    """Adds a level's parts to the sums of all camera samples."""
    for total, part in zip(sums, parts, strict=False):
        dr.scatter(total, dr.gather(type(total), total, lanes) + part, lanes)
    dr.eval(sums)
