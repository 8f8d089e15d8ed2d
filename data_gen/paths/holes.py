"""Holes: surfaces that let a part of the light pass straight through, such as masks and thin panes.

A path that meets a hole passes it by chance, at a vertex of its own (``vertex.NULL``). A ray toward an emitter goes
straight on and is weakened by T, as in Mitsuba's ``volpath``. Both techniques find the same light, so the density of a
direction is the same behind a hole as before it. Each hole counts in ``max_depth``, as in ``path``, whichever technique
passes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import NULL, SMOOTH, ByMaterial, dr_number
from data_gen.scenes.facts import shapes_of
from data_gen.scenes.integrators import objects_in

# Materials for which the share of light that goes straight through is known, if it is known for all materials inside
_KNOWN = ("MaskBSDF", "Null", "ThinDielectric", "BlendBSDF")


@dataclass
class _Straight:
    """The point ``o`` from which a path has gone straight on, through holes if there are any."""

    o: mi.Point3f

    def seen_by(self, x: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """``x`` moved to ``o``, to evaluate the density of sampling an emitter from there."""
        there = mi.SurfaceInteraction3f(x)
        there.p = mi.Point3f(self.o)
        return there


@dataclass
class Aim(_Straight):
    """A straight way from ``o``, whose direction was sampled with density ``p``. ``p`` is infinite if emitters cannot
    be sampled from ``o``: at the camera and at mirrors.
    """

    p: mi.Float

    @classmethod
    def of_camera(cls, o: mi.Point3f) -> Aim:
        return cls(mi.Point3f(o), dr.full(mi.Float, dr.inf, dr.width(o)))

    def behind(self, passed: mi.Bool, x: mi.SurfaceInteraction3f, kind: mi.UInt32, p: mi.Float) -> Aim:
        """The aim behind vertex ``x``. The event there had this ``kind`` and density ``p``, or ``passed`` a hole."""
        return Aim(
            dr.select(passed, self.o, x.p), dr.select(passed, self.p, dr.select(kind == SMOOTH, p, mi.Float(dr.inf)))
        )


@dataclass
class Edge(_Straight):
    """An edge of a path from the camera or from a lamp. It may lead through several holes."""

    first: mi.Bool  # whether it begins at the camera or at a lamp

    def behind(self, passed: mi.Bool, x: mi.SurfaceInteraction3f) -> Edge:
        """The edge behind vertex ``x``. ``passed``: the path has passed a hole there."""
        return Edge(dr.select(passed, self.o, x.p), self.first & passed)

    def length2(self, x: mi.SurfaceInteraction3f) -> mi.Float:
        return dr.squared_norm(x.p - self.o)


class Holes:
    """Materials that let a known share of the light go straight through."""

    def __init__(self, bsdfs: list[mi.BSDF]):
        numbers = {dr_number(mi.BSDFPtr(bsdf)) for bsdf in bsdfs}
        table = [number in numbers for number in range(max(numbers) + 1)]
        self.known = ByMaterial(mi.Bool(table))

    def passed(self, bsdf: mi.BSDFPtr, kind: mi.UInt32) -> mi.Bool:
        """Whether an event of this ``kind`` goes straight through a hole, as rays toward emitters do."""
        return (kind == NULL) & self.known.of(bsdf)[1]

    def share(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """The share that goes straight through at ``si``; 0 where nothing does, or where it is unknown."""
        bsdf = si.bsdf()
        listed, known = self.known.of(bsdf, active)
        known &= listed
        return mi.Spectrum(dr.select(known, bsdf.eval_null_transmission(si, known), 0))

    @classmethod
    def of(cls, scene: mi.Scene, passed: Callable[[mi.Shape], bool] = lambda shape: False) -> Holes | None:
        """The holes of a scene, or None if it has none. Shapes for which ``passed`` is true are left out."""
        bsdfs = (shape.bsdf() for shape in shapes_of(scene) if not passed(shape))
        some = [bsdf for bsdf in bsdfs if bsdf is not None and has_holes(bsdf) and knows(bsdf)]
        return cls(some) if some else None

    def behind(
        self, si: mi.SurfaceInteraction3f, T: mi.Spectrum, left: mi.UInt32, going: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32, mi.Bool]:
        """``T``, the number of holes ``left`` and which rays are still ``going``, behind the surface at ``si``."""
        T = dr.select(going, mi.Spectrum(T * dr.select(left > 0, self.share(si, going), 0)), T)
        going = going & (dr.max(T) > 0)
        return T, dr.select(going, left - 1, left), going

    @dr.syntax
    def transmittance(
        self, scene, ray: mi.Ray3f, target: mi.Point3f, most, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """T along ``ray`` to the ``target``, and the number of holes on it. T is 0 if there are more than ``most``."""
        ray, left, going = mi.Ray3f(ray), mi.UInt32(most), mi.Bool(active)
        T = dr.select(active, mi.Spectrum(1), 0)
        while dr.hint(going, label="holes"):
            hit = scene.ray_intersect_preliminary(ray, active=going)
            going &= hit.is_valid()
            si = hit.compute_surface_interaction(ray, mi.RayFlags.All, going)
            T, left, going = self.behind(si, T, left, going)
            ray = si.spawn_ray_to(target)
        return T, most - left

    @dr.syntax
    def toward_camera(
        self, scene, si: mi.SurfaceInteraction3f, target: mi.Point3f, most, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """As ``transmittance()`` from ``si`` to a camera from which lamps are hidden.

        There a lamp blocks light only if a hole is between the lamp and the camera."""
        ray, left, going = si.spawn_ray_to(target), mi.UInt32(most), mi.Bool(active)
        # T as a surface sees it, and T as the camera sees it
        T, seen = dr.select(active, mi.Spectrum(1), 0), dr.select(active & ~_on_lamp(si, scene), mi.Spectrum(1), 0)
        left_there = mi.UInt32(left)
        while dr.hint(going, label="holes"):
            hit = scene.ray_intersect_preliminary(ray, active=going)
            going &= hit.is_valid()
            si = hit.compute_surface_interaction(ray, mi.RayFlags.All, going)
            T, left, _ = self.behind(si, T, left, going)
            shows = going & ~_on_lamp(si, scene)
            seen, left_there = dr.select(shows, T, seen), dr.select(shows, left, left_there)
            going &= (dr.max(T) > 0) | (dr.max(seen) > 0)
            ray = si.spawn_ray_to(target)
        return seen, most - left_there

    @dr.syntax
    def through(
        self, scene, x: mi.SurfaceInteraction3f, d: mi.Vector3f, number, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum]:
        """The vertex behind ``number`` holes along ``d``, and the transmittance T of these holes.

        ``x`` is at the first hole. T is 0 if there are fewer holes.
        """
        x, T, left, active = mi.SurfaceInteraction3f(x), mi.Spectrum(1), mi.UInt32(number), mi.Bool(active)
        going = active & (left > 0)
        while dr.hint(going, label="holes"):
            T, left, going = self.behind(x, T, left, going)
            x = dr.select(going, scene.ray_intersect(x.spawn_ray(d), going), x)
            going &= left > 0
        return x, T


def _on_lamp(si: mi.SurfaceInteraction3f, scene: mi.Scene) -> mi.Bool:
    return si.emitter(scene) != None  # noqa: E711 - a comparison of arrays of pointers


def has_holes(bsdf: mi.BSDF) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)


def knows(bsdf: mi.BSDF) -> bool:
    """Whether the share that goes straight through is known. Bump and normal maps around a mask wrongly report 0."""
    return not has_holes(bsdf) or (bsdf.class_name() in _KNOWN and all(map(knows, objects_in(bsdf, mi.BSDF))))
