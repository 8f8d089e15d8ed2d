"""What paths from either end of a scene have to agree in: how long they are, what the camera sees, where they merge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import World
from data_gen.paths.walk import Limits
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial


@dataclass(kw_only=True)
class Plan(World):
    limits: Limits
    longest: int  # the number of edges up to which paths are found from both ends
    first_hit: Callable  # (scene, ray, active): where a ray from the camera leads
    hidden: Callable  # (scene, vertex, direction toward the camera, active): whether something is between the two
    η: mi.Float | None = None  # of ``mis``, where photons are gathered, too

    @property
    def joins(self) -> bool:
        return self.longest > 1 and self.lights.emitters is not None

    def merged(self, bsdf: mi.BSDFPtr, joins: mi.Bool | bool = True) -> mi.Float:
        """η at a vertex of that material; 0 where nothing merges."""
        if self.η is None:
            return mi.Float(0)
        return dr.select(self.materials.connectable(bsdf) & joins, self.η, 0)

    def known(self, end: Partial, bsdf: mi.BSDFPtr) -> Partial:
        """What a light path knows at a vertex of that material, where photons are gathered if it scatters widely."""
        return end if self.η is None else mis.gathered(end, self.merged(bsdf))
