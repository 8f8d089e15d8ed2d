"""Gradient samples of gathered photons: computed for all pairs of a camera path and a thing near it, and summed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import World
from data_gen.paths.mis import gradient_weight
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.photons.passes import Passes, begun
from ngpt_studies.photons.gradients.camera import CameraPaths, Level
from ngpt_studies.photons.gradients.pairs import Near, Pairs, pieces

# Levels are joined until they have this number of paths for each camera sample.
LEVELS = 3
# Pairs of a point and a photon that are in memory together, for each camera sample; and the bytes of one.
PAIRS = 16
PAIR_BYTES = 192


@dataclass
class Gathered:
    """The things near to camera paths in a photon map, or in a part of it."""

    on_surfaces: Any  # ``gpm.OnSurfaces`` or None
    in_media: Near | None = None


@dataclass
class GradientPasses(Passes):
    """Passes whose camera paths go side by side with those of the neighbouring pixels."""

    walk: CameraPaths


def gradient_pass(
    passes: GradientPasses, camera: CameraSamples, film: GradientFilm, near: Callable, pairs: int
) -> None:
    """One photon map, and one camera path and its four shifts for each camera sample; a pixel has one sample.

    ``near`` (passes, photon map) yields what is ``Gathered`` of a map; ``pairs`` are in memory together for each camera
    sample.
    """
    integrator, walk, frozen, n = passes.integrator, passes.walk, passes.frozen, dr.width(camera.pixel)
    start, values = begun(passes, camera)
    shifted = [camera.rays(shift) for shift in SHIFTS.values()]
    rays = [(mi.Ray3f(start.ray), start.importance, mi.Bool(True))]
    rays += [(mi.Ray3f(ray), importance, inside) for ray, importance, inside in shifted]
    dr.eval(values, rays)
    # The primal, the four Δ, and how many photons were gathered and had no copy
    sums = [dr.zeros(mi.Spectrum, n) for _ in range(1 + len(SHIFTS))] + [dr.zeros(mi.Point2f, n)]
    Le, first = mi.Spectrum(0), True
    for levels in groups(walk.levels(rays, start.random, frozen), LEVELS * n):
        # ------------------------- Emission that paths meet --------------------------
        for level in levels:
            if first:
                Le = walk.direct(level, start, frozen)
                if level.behind:
                    add_to(sums, level.lanes, frozen(differences_behind, level.behind, level.paths))
            else:
                add_to(sums, level.lanes, frozen(walk.emitted, level))
            first = False
        # ------------------------- Photons that are near -----------------------------
        lanes, level = [level.lanes for level in levels], joined(passes, levels)
        del levels
        longest = dr.opaque(mi.UInt32, integrator.limits.max_depth) - level.depth
        dr.eval(longest)
        together = [dr.zeros(type(total), dr.width(level.lanes)) for total in sums]
        for traced in integrator.maps(passes, camera):
            for gathered in near(passes, traced):
                for part in parts(passes, gathered, level, longest, pairs * n):
                    together = [total + value for total, value in zip(together, part, strict=True)]
                    dr.eval(together)
        low = 0
        for some in lanes:
            places = dr.arange(mi.UInt32, dr.width(some)) + dr.opaque(mi.UInt32, low)
            add_to(sums, some, [dr.gather(type(total), total, places) for total in together])
            low += dr.width(some)
    L, *Δ, counts = sums
    wavelengths = start.ray.wavelengths
    values |= {"primal": to_rgb(L + Le, wavelengths), "direct": to_rgb(Le, wavelengths)}
    if integrator.diagnostics:
        values["shift_failures"] = counts.y / dr.fmax(counts.x, 1)
    film.put_all(values)
    for name, one, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
        film.put(name, to_rgb(one, wavelengths), inside)


# ------------------------------- Levels -------------------------------


def groups(levels: Iterable[Level], most: int) -> Iterator[list[Level]]:
    """The levels, in groups of at most this number of paths: a kernel for few paths takes as long as one for many."""
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
    paths = [dr.empty(type(path), n) for path in levels[0].paths]
    all_of_it = [dr.empty(mi.UInt32, n), dr.empty(mi.UInt32, n), paths]
    for level in levels:
        parts = [level.lanes, level.depth, level.paths]
        all_of_it = passes.frozen(entered, all_of_it, parts, dr.opaque(mi.UInt32, low))
        dr.eval(all_of_it)
        low += dr.width(level.lanes)
    lanes, depth, paths = all_of_it
    return replace(levels[0], lanes=lanes, depth=depth, paths=paths)


def entered(all_of_it: list, values: list, low: mi.UInt32) -> list:
    """``all_of_it``, a tree of arrays, where ``values`` replace the entries from place ``low`` on."""
    dr.scatter(all_of_it, values, low + dr.arange(mi.UInt32, dr.width(values[0])))
    return all_of_it


def add_to(sums: list, lanes: mi.UInt32, parts: list) -> None:
    for total, part in zip(sums, parts, strict=False):
        dr.scatter(total, dr.gather(type(total), total, lanes) + part, lanes)
    dr.eval(sums)


# ------------------------------- Pairs --------------------------------


def parts(passes: GradientPasses, near: Gathered, level: Level, longest: mi.UInt32, most: int) -> Iterator[list]:
    """The differences from what is ``near`` to a level's paths."""
    at_surfaces = passes.walk.at_surfaces(level, passes.frozen)
    if near.on_surfaces is not None:
        receivers = passes.frozen(spread_out, near.on_surfaces, passes.world, at_surfaces)
        dr.eval(receivers)
        yield from differences(passes, near.on_surfaces, receivers, longest, most)
    if near.in_media is not None:
        yield from differences(passes, near.in_media, level.paths, longest, most)


def differences(passes: Passes, near: Near, paths: list, longest: mi.UInt32, most: int) -> Iterator[list]:
    """Piece by piece of all pairs, the sums for each base path: L, four Δ, and counts of photons.

    ``longest``: edges that the light path of a photon may have, of each base path.
    """
    frozen, world = passes.frozen, passes.world
    # The kernel is recorded each time, which is quick. Its result may hold a whole map, which Dr.Jit cannot make anew.
    points, receives = near.where(world, paths[0])
    dr.eval(points, receives)
    for pairs in pieces(near, points, receives, most, frozen):
        found = frozen(of_pairs, near, world, pairs, paths, longest)
        dr.eval(found)
        places = [dr.compress(one) for one in found.apart]
        known = [k for k, some in enumerate(places) if dr.width(some)]
        if known:
            # One kernel holds all shifts, since for small images a launch takes longer than the kernel runs.
            some = dr.concat([places[k] for k in known])
            which = dr.concat([dr.full(mi.UInt32, k, dr.width(places[k])) for k in known])
            copied = frozen(of_copies, near, world, pairs, paths, found.C, (some, which))
            for k, one in enumerate(found.Δ):
                dr.scatter(one, copied, some, which == k)
            dr.eval(found.Δ)
        sums = frozen(summed, pairs, found)
        dr.eval(sums)
        yield sums


@dataclass
class Found:
    C: mi.Spectrum  # to the base path
    Δ: list  # gradient samples, with the thing for its own copy; where it is not, with none
    shifts: mi.Float  # that the pair takes part in
    apart: list  # of each shift whether a copy is to be looked for


def spread_out(near: Any, world: World, paths: list) -> list:
    return [near.spread(world, path) for path in paths]


def of_pairs(near: Near, world: World, pairs: Pairs, paths: list, longest: mi.UInt32) -> Found:
    """Returns the contribution of each pair without copies at another place."""
    A, *others = (near.receiver(world, [path], None, pairs.point) for path in paths)
    thing = near.thing(pairs.place)
    C, met = near.brought(thing, A, thing.depth <= dr.gather(mi.UInt32, longest, pairs.point))
    lit = dr.max(C) > 0
    shared = [near.shared(thing, met, B, lit) for B in others]
    Δ = [difference(C, C1, mi.Float(1)) for C1, _ in shared]
    return Found(C, Δ, mi.Float(dr.select(lit, len(SHIFTS), 0)), [apart for _, apart in shared])


def of_copies(near: Near, world: World, pairs: Pairs, paths: list, C: mi.Spectrum, asked: tuple) -> mi.Spectrum:
    """Returns Δ, by copies at another place, of the pairs and shifts that are ``asked`` for: (some, which)."""
    some, which = asked
    point, place = dr.gather(mi.UInt32, pairs.point, some), dr.gather(mi.UInt32, pairs.place, some)
    A, B = near.receiver(world, paths[:1], None, point), near.receiver(world, paths[1:], which, point)
    C1, r = near.copied(world, near.thing(place), A, B)
    return difference(dr.gather(mi.Spectrum, C, some), C1, r)


def summed(pairs: Pairs, found: Found) -> list:
    """Returns the sums of all values over the pairs of each point. Pairs without a copy are counted."""
    failures = mi.Float(0)
    for one in found.Δ:
        failures += dr.select((found.shifts > 0) & dr.all(one == -2 * found.C), 1, 0)
    return pairs.sums([found.C, *found.Δ, mi.Point2f(found.shifts, failures)])


def chosen(fields: Callable, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> tuple:
    """``fields`` (path, index) of the path of number ``which``, if there is more than one."""
    found = fields(paths[0], index)
    for k, path in enumerate(paths[1:], 1):
        here = which == k
        found = tuple(dr.select(here, new, old) for new, old in zip(fields(path, index), found, strict=True))
    return found


def difference(C: mi.Spectrum, C1: mi.Spectrum, r: mi.Float) -> mi.Spectrum:
    """Returns Δ of a path and its copy. A copy that carries no light counts as none. It must be black in all channels,
    so that both directions agree.
    """
    good = (dr.max(C1) > 0) & dr.isfinite(dr.sum(C1)) & dr.isfinite(r)
    return dr.select(dr.max(C) > 0, gradient_weight(r, good) * (dr.select(good, C1, 0) - C), 0)


def differences_behind(behind: list, paths: list) -> list:
    """Returns the light that base paths have seen behind grids, and its four Δ."""
    C, *others = behind
    return [C, *(gradient_weight(mi.Float(1), y.alive) * (C1 - C) for y, C1 in zip(paths[1:], others, strict=True))]
