r"""Gradient-domain photon mapping on surfaces: ``ppm``, and each photon that is gathered shifted to four neighbours.

    x, y        the vertex of a camera path where photons are gathered, and that of the neighbouring pixel's path
    b, b'       a photon and its copy: light path and camera path together make the path, and its copy
    C, C'       f β Φ / (π r² N) of either, both with the density of the photon's path
    r           p' J / p of the copy
    Δ           gradient sample, the sum of 2 w (C' - C) over all photons, w = 1 / (1 + r)

A photon that is near to x and to y is its own copy: r = 1, and no ray is traced. What it brings to both is the same
but for f and β, be it light from a wall or a caustic. With a radius of three pixels, four photons of five are of this
kind, of one pixel two of five. Others go where ``shift`` has them, see ``copies``. A photon without a copy has w = 1.

Camera paths are shifted by replay: see ``camera``. Emission that they meet behind mirrors and glass is shifted with
them; that which is seen directly is not part of the gradients.

[Hua et al. 2017, "Gradient-Domain Photon Density Estimation"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering",
section 4.3; Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 4]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.shift import gradient_weight
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.bdpt.lights import LightRay
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.camera import Level, levels
from data_gen.samplers.photons.camera import Path as CameraPath
from data_gen.samplers.photons.copies import copy, is_near, light, photon_of
from data_gen.samplers.photons.grid import Grid
from data_gen.samplers.photons.pairs import Pairs, pieces
from data_gen.samplers.photons.ppm import PPM, Passes, begin
from data_gen.samplers.photons.radius import shrunk

# Pairs of a point and a photon that are in memory together, for each camera sample; and the bytes of one.
PAIRS = 16
PAIR_BYTES = 192
# Of a camera sample beside that: five paths with their rays, hits and throughputs, and as many sums
PATHS_BYTES = 1024


class GPM(PPM):
    """Gradient-domain photon mapping on surfaces.

    Plugin ``gpm``. Parameters are those of ``ppm``, and

    ``diagnostics``  false; true adds the layer ``shift_failures``, the share in [0, 1] of the photons gathered at a
                     pixel that have no copy

    Not handled: what ``ppm`` does not handle. Photons that come through glass have no copies but themselves.
    """

    name = "gpm"
    camera_bytes = PATHS_BYTES + PAIRS * PAIR_BYTES

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.diagnostics = props.get("diagnostics", False)

    def maps_of(self, passes: Passes, keys, number: int) -> Iterator[Near]:
        """The photon maps of pass ``number``."""
        if passes.lights.emitters is not None and self.max_depth > 1:
            radius = self.radius * passes.width * shrunk(number)
            starts, maps = self.photon_maps(passes, keys)
            for photons in maps:
                yield Near(starts, photons, radius, self.photons * dr.width(keys[0]))

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """One photon map, and one camera path and its four shifts for each camera sample, of which a pixel has one."""
        ray, importance, random, keys, values = begin(passes, camera)
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        rays = [(mi.Ray3f(ray), importance, mi.Bool(True)), *((mi.Ray3f(r), *more) for r, *more in shifted)]
        dr.eval(values, rays)
        n, scene, frozen = dr.width(camera.pixel), passes.scene, passes.frozen

        def walk():
            paths = passes.materials, random, rays, self.first_hit, self.hide_emitters
            return levels(scene, *paths, self.max_depth, self.rr_depth, frozen)

        # The primal, the four Δ, and how many photons were gathered and had no copy
        sums = [dr.zeros(mi.Spectrum, n) for _ in range(1 + len(SHIFTS))] + [dr.zeros(mi.Point2f, n)]
        Le = mi.Spectrum(0)
        # Emission that camera paths meet is counted with the first map, or without any.
        maps, emission = self.maps_of(passes, keys, camera.first), True
        near = next(maps, None)
        while near is not None or emission:
            for level in walk():
                if emission and level.depth > 1:
                    add_to(sums, level.lanes, frozen(emitted, scene, level.base, level.offsets))
                elif emission and self.max_depth > 0:
                    Le = frozen(CameraPath.emission, level.base, scene, fixed=True)
                if near is not None and level.depth < self.max_depth:
                    for part in differences(passes, near, level, self.max_depth - level.depth, PAIRS * n):
                        add_to(sums, level.lanes, part)
            near, emission = next(maps, None), False
        L, *Δ, counts = sums
        values |= {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        if self.diagnostics:
            values["shift_failures"] = counts.y / dr.fmax(counts.x, 1)
        film.put_all(values)
        for name, difference, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
            film.put(name, to_rgb(difference, ray.wavelengths), inside)


@dataclass(init=False)
class Near:
    """The photons of a map where they are gathered, and where their light paths start."""

    starts: LightRay
    photons: Any
    grid: Grid
    radius2: mi.Float
    K: mi.Float

    def __init__(self, starts: LightRay, photons, radius: float, paths: int):
        self.starts, self.photons = starts, photons
        self.grid = Grid(photons.p, photons.depth > 0, radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * paths))


def differences(passes: Passes, near: Near, level: Level, longest: int, most: int) -> Iterator[list]:
    """Piece by piece of the pairs of a level, the sums for each of its points: L, four Δ, and counts of photons."""
    frozen, edges = passes.frozen, dr.opaque(mi.UInt32, min(longest, 0xFFFFFFFF))
    p, receives = frozen(receivers, passes.materials, level.base)
    dr.eval(p, receives)
    for pairs in pieces(near.grid, p, near.radius2, receives, most, frozen):
        values, apart = frozen(of_pairs, passes.materials, near, pairs, level.base, level.offsets, edges)
        dr.eval(values, apart)
        C, *Δ, counts = values
        places = [dr.compress(one) for one in apart]
        known = [k for k, some in enumerate(places) if dr.width(some)]
        if known:
            # All shifts in one kernel: to launch one takes longer than to run it, where images are small.
            some = dr.concat([places[k] for k in known])
            which = dr.concat([dr.full(mi.UInt32, k, dr.width(places[k])) for k in known])
            ends = passes.scene, passes.lights, passes.materials
            copied = frozen(of_copies, *ends, near, pairs, some, which, level.base, level.offsets, C)
            for k, one in enumerate(Δ):
                dr.scatter(one, copied, some, which == k)
            dr.eval(Δ)
        sums = frozen(summed, pairs, C, Δ, counts)
        dr.eval(sums)
        yield sums


def receivers(materials, base: CameraPath) -> tuple[mi.Point3f, mi.Bool]:
    """The vertices of base paths, and whether photons are gathered there."""
    x = base.vertex()
    return mi.Point3f(x.p), base.alive & x.is_valid() & materials.connectable(x.bsdf())


def of_pairs(materials, near: Near, pairs: Pairs, base: CameraPath, offsets: list, longest: mi.UInt32) -> tuple:
    """Of each pair C, four Δ with the photon for its copy, and counts; and where a copy is to be looked for."""
    photons, radius2 = near.photons, near.radius2
    j = dr.gather(mi.UInt32, near.grid.index, pairs.place)
    photon = photon_of(photons, j)
    short = dr.gather(mi.UInt32, photons.depth, j) <= longest
    direct = dr.isfinite(dr.gather(mi.Float, photons.density, j))
    x, β = point_of([base], None, pairs.point)
    gathered = short & is_near(photon, x, radius2)
    C = β * light(photon, x, x.bsdf(), gathered) * near.K
    lit = dr.max(C) > 0
    Δ, apart = [], []
    for offset in offsets:
        y, β1 = point_of([offset], None, pairs.point)
        receives = lit & dr.gather(mi.Bool, offset.alive, pairs.point)
        receives &= y.is_valid() & materials.connectable(y.bsdf())
        shared = receives & is_near(photon, y, radius2)
        C1 = β1 * light(photon, y, y.bsdf(), shared) * near.K
        Δ.append(difference(C, C1, mi.Float(1)))
        apart.append(receives & ~shared & direct)
    return [C, *Δ, mi.Point2f(dr.select(lit, len(SHIFTS), 0), 0)], apart


def of_copies(
    scene, lights, materials, near: Near, pairs: Pairs, some: mi.UInt32, which: mi.UInt32, base, offsets: list, C
) -> mi.Spectrum:
    """Δ by the shift of number ``which`` of ``some`` pairs, whose photons are near to the base path alone."""
    point, place = (dr.gather(mi.UInt32, index, some) for index in (pairs.point, pairs.place))
    j, C = dr.gather(mi.UInt32, near.grid.index, place), dr.gather(mi.Spectrum, C, some)
    x, _ = point_of([base], None, point)
    y, β = point_of(offsets, which, point)
    photon, everywhere = photon_of(near.photons, j), dr.full(mi.Bool, True, dr.width(j))
    ends = scene, lights, materials.connectable, near.starts, near.photons
    moved, r, good = copy(*ends, j, photon, x, y, near.radius2, everywhere)
    return difference(C, β * light(moved, y, y.bsdf(), good) * near.K, r)


def summed(pairs: Pairs, C: mi.Spectrum, Δ: list, counts: mi.Point2f) -> list:
    """Of each point the sums of all over its pairs; pairs without a copy are counted."""
    failures = mi.Float(0)
    for one in Δ:
        failures += dr.select((counts.x > 0) & dr.all(one == -2 * C), 1, 0)
    return pairs.sums([C, *Δ, mi.Point2f(counts.x, failures)])


def point_of(paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum]:
    """A vertex of camera paths, and their throughput; of the path of number ``which``, if there is more than one."""
    o, d, hit, β = parts(paths[0], index)
    for k, path in enumerate(paths[1:], 1):
        here = which == k
        both = zip(parts(path, index), (o, d, hit, β), strict=True)
        o, d, hit, β = (dr.select(here, new, old) for new, old in both)
    return hit.compute_surface_interaction(mi.Ray3f(o, d)), β


def parts(path, index: mi.UInt32) -> tuple:
    """Origin, direction and hit of a path's ray, and its throughput."""
    o, d = dr.gather(mi.Point3f, path.ray.o, index), dr.gather(mi.Vector3f, path.ray.d, index)
    return o, d, dr.gather(mi.PreliminaryIntersection3f, path.hit, index), dr.gather(mi.Spectrum, path.β, index)


def difference(C: mi.Spectrum, C1: mi.Spectrum, r: mi.Float) -> mi.Spectrum:
    """Δ of a path and its copy. One that carries no light is none: black is black from either end, in all channels."""
    good = (dr.max(C1) > 0) & dr.isfinite(dr.sum(C1)) & dr.isfinite(r)
    return dr.select(dr.max(C) > 0, gradient_weight(r, good) * (dr.select(good, C1, 0) - C), 0)


def emitted(scene, base: CameraPath, offsets: list) -> list:
    """Emission that base paths meet, and its four Δ."""
    C = base.emission(scene)
    return [C, *(gradient_weight(mi.Float(1), path.alive) * (path.emission(scene) - C) for path in offsets)]


def add_to(sums: list, lanes: mi.UInt32, parts: list) -> None:
    """Adds a level's parts to the sums of all camera samples."""
    for total, part in zip(sums, parts, strict=False):
        dr.scatter(total, dr.gather(type(total), total, lanes) + part, lanes)
    dr.eval(sums)


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gpm``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "gpm", **options).prepare(scene)


mi.register_integrator("gpm", lambda props: GPM(props))
