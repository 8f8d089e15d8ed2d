"""Rules that camera paths and light paths share: their length, what the camera sees, and where they merge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.holes import Edge
from data_gen.paths.light_ends import World
from data_gen.paths.vertex import event_kind
from data_gen.paths.walk import Limits
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.vertex import Vertex, cosine


@dataclass(kw_only=True)
class Plan(World):
    """The scene and the rules for its paths."""

    limits: Limits
    longest: int  # the number of edges up to which paths are found from both ends
    first_hit: Callable  # (scene, ray, active): where a ray from the camera leads
    hidden: Callable  # (scene, vertex, direction to the camera, active): whether the camera does not see the vertex
    η: mi.Float | None = None  # of ``mis``; None if no photons are gathered

    @property
    def joins(self) -> bool:
        return self.longest > 1 and self.lights.emitters is not None

    def merged(self, bsdf: mi.BSDFPtr, joins: mi.Bool | bool = True) -> mi.Float:
        """η at a vertex of this material; 0 where nothing merges."""
        if self.η is None:
            return mi.Float(0)
        return dr.select(self.materials.connectable(bsdf) & joins, self.η, 0)

    def known(self, end: Partial, bsdf: mi.BSDFPtr) -> Partial:
        """The partial sums of a light path at a vertex of this material, with η where photons are gathered."""
        return end if self.η is None else mis.gathered(end, self.merged(bsdf))

    # ------------------------------- Edges through holes -------------------------------

    def begins(self, o: mi.Point3f) -> Edge | None:
        """The first edge of a path, measured from ``o``; None without holes."""
        return Edge(mi.Point3f(o), dr.full(mi.Bool, True, dr.width(o))) if self.holes else None

    def onward(self, x: Vertex, bsdf, sample: mi.BSDFSample3f, end: Partial) -> tuple[Partial, Edge | None]:
        """``end`` and the edge behind the sampled event at ``x``. If the event passed a hole, the edge continues."""
        if self.holes is None:
            return end, None
        passed = self.holes.passed(bsdf, event_kind(sample.sampled_type))
        return self.carried(passed, x, end), x.edge.behind(passed, x.si)

    def carried(self, passed: mi.Bool, x: Vertex, end: Partial) -> Partial:
        """``end``, the partial sums behind ``x``; where the path has ``passed`` a hole at ``x``, those before ``x``."""
        same = mis.passed(x.end, cosine(x.si, x.si.to_world(x.si.wi)), x.edge.length2(x.si))
        parts = ((getattr(same, name), getattr(end, name)) for name in ("vcm", "vc", "waiting"))
        return Partial(*(dr.select(passed, a, b) for a, b in parts))

    def arrives(self, end: Partial, edge: Edge | None, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> Partial:
        """``end`` at the next vertex ``si``, which may be a hole."""
        return mis.arrive(end, cosine(si, d), dr.square(si.t) if edge is None else edge.length2(si))

    def sees(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, most: mi.UInt32, active) -> tuple[Any, Any]:
        """The transmittance from ``target`` to ``si`` through at most ``most`` holes, and the number of holes."""
        ray = si.spawn_ray_to(target)
        if self.holes is None:
            return dr.select(self.scene.ray_test(ray, active), mi.Float(0), 1), 0
        return self.holes.transmittance(self.scene, ray, target, most, active)

    def seen_by_camera(self, y: Vertex, camera: mi.DirectionSample3f, active) -> Any:
        """The transmittance from ``y`` to the camera."""
        if self.holes is None:
            return dr.select(self.hidden(self.scene, y.si, camera, active), mi.Float(0), 1)
        return self.through_holes_to_camera(y, camera, active)[0]

    def through_holes_to_camera(self, y: Vertex, camera: mi.DirectionSample3f, active) -> tuple[mi.Spectrum, mi.UInt32]:
        """As ``seen_by_camera()``, in a scene with holes; the second value is the number of holes."""
        most = self.longest - 1 - y.depth
        if self.limits.hide_emitters:
            return self.holes.toward_camera(self.scene, y.si, camera.p, most, active)
        return self.sees(y.si, camera.p, most, active)
