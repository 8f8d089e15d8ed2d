"""Holes: surfaces that let a part of the light pass straight through, such as masks and thin panes.

Where a path meets a hole, random BSDF sampling decides whether it passes, and this counts as a separate vertex
(``vertex.NULL``). A shadow ray goes straight through all holes, and its light is multiplied by their transmittance T,
as in Mitsuba's ``volpath``. Both techniques find the same light through a hole. For their MIS weights, a path keeps the
point and the density with which its direction was last sampled, however many holes it has passed since. Each hole
counts in ``max_depth``, as in ``path``, whichever technique passes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import NULL, SMOOTH, ByMaterial, dr_number
from data_gen.scenes.facts import shapes_of
from data_gen.scenes.integrators import objects_in

# Materials that report the share of light that goes straight through, if all materials nested in them do
_KNOWN = ("MaskBSDF", "Null", "ThinDielectric", "BlendBSDF")


@dataclass
class _Straight:
    """A straight piece of a path that begins at the point ``o``, and may pass through holes."""

    o: mi.Point3f

    def seen_by(self, x: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """``x`` moved to ``o``, to evaluate the density with which an emitter is sampled from ``o``."""
        there = mi.SurfaceInteraction3f(x)
        there.p = mi.Point3f(self.o)
        return there


@dataclass
class Aim(_Straight):
    """A straight piece whose direction was sampled at ``o`` with density ``p``.

    ``p`` is infinite where emitters cannot be sampled from ``o``: at the camera and at mirrors.
    """

    p: mi.Float

    @classmethod
    def of_camera(cls, o: mi.Point3f) -> Aim:
        return cls(mi.Point3f(o), dr.full(mi.Float, dr.inf, dr.width(o)))

    def behind(self, passed: mi.Bool, x: mi.SurfaceInteraction3f, kind: mi.UInt32, p: mi.Float) -> Aim:
        """The aim behind vertex ``x``.

        ``passed``: whether the path went straight through a hole at ``x``, so that the old aim stays. Otherwise the
        event had this ``kind`` and density ``p``.
        """
        return Aim(
            dr.select(passed, self.o, x.p), dr.select(passed, self.p, dr.select(kind == SMOOTH, p, mi.Float(dr.inf)))
        )


@dataclass
class Edge(_Straight):
    """An edge of a path that was traced from the camera or from a lamp. The edge may pass through several holes."""

    first: mi.Bool  # whether this is the path's first edge, which begins at the camera or lamp and not at a surface

    def behind(self, passed: mi.Bool, x: mi.SurfaceInteraction3f) -> Edge:
        """The edge behind vertex ``x``. ``passed``: whether the path went straight through a hole at ``x``."""
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
        """The share of light that goes straight through at ``si``; 0 where it is unknown."""
        bsdf = si.bsdf()
        listed, known = self.known.of(bsdf, active)
        known &= listed
        return mi.Spectrum(dr.select(known, bsdf.eval_null_transmission(si, known), 0))

    @classmethod
    def of(cls, scene: mi.Scene, passed: Callable[[mi.Shape], bool] = lambda shape: False) -> Holes | None:
        """The holes of a scene, or None if the scene has no holes. Shapes for which ``passed`` is true are left out."""
        bsdfs = (shape.bsdf() for shape in shapes_of(scene) if not passed(shape))
        some = [bsdf for bsdf in bsdfs if bsdf is not None and has_holes(bsdf) and knows(bsdf)]
        return cls(some) if some else None

    def behind(
        self, si: mi.SurfaceInteraction3f, T: mi.Spectrum, left: mi.UInt32, going: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32, mi.Bool]:
        """Updates three values at the surface ``si``.

        They are the transmittance ``T``, ``left`` (how many more holes may be passed) and ``going`` (whether the ray
        continues).
        """
        T = dr.select(going, mi.Spectrum(T * dr.select(left > 0, self.share(si, going), 0)), T)
        going = going & (dr.max(T) > 0)
        return T, dr.select(going, left - 1, left), going

    @dr.syntax
    def transmittance(
        self, scene, ray: mi.Ray3f, target: mi.Point3f, most, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """T along ``ray`` to the ``target``, and the number of holes on it. T is 0 with more than ``most`` holes."""
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

        Such a camera sees straight through a lamp that it would see directly. But a lamp seen through a hole is visible
        as usual, and blocks the light behind it.
        """
        ray, left, going = si.spawn_ray_to(target), mi.UInt32(most), mi.Bool(active)
        # T with lamps blocking light as usual, and T for the camera, which sees straight through lamps up to the hole
        # nearest to it
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
