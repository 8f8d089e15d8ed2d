r"""Progressive photon mapping in media and on surfaces: ``ppm``, and photons where light scatters in a medium.

    x           the vertex of a camera path in a medium, at a sampled distance
    b, d, Φ     a photon within radius r of it, in the same medium; the direction it came along, its scattered power
    L(x)        Σ f(d) Φ / (4/3 π r³ N),    f: the phase function, N: light paths of the pass

Φ is the power that is scattered at b, and the camera path brings T over the density of x, without σs. In scenes with
media whose density varies it is Φ / σs(b), and the camera path has σs(x). Paths of both ends go by null collisions.

Each segment of a camera path has one vertex: where it scatters in a medium, or on the surface behind. All light that is
scattered in a medium comes from photons there. This includes light that arrives directly from lamps: the photons of a
lamp draw its beam in haze.

[Jensen and Christensen 1998, "Efficient Simulation of Light Transport in Scenes with Participating Media using Photon
Maps"; Knaus and Zwicker 2011, section 5]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import media
from data_gen.samplers.photons.integrator import MEDIA_MAP_BYTES, Traced
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import in_media
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.photons.surfaces.ppm import PPM, Gathering


@dataclass(init=False)
class GatheringInMedia:
    """The photons of a map where they are gathered in media; for paths of at most ``max_depth`` edges."""

    photons: Any
    Φ: mi.Spectrum
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    max_depth: mi.UInt32

    def __init__(self, fog: Fog, traced: Traced, max_depth: int):
        self.photons, radius = traced.photons, traced.radius(3)
        self.Φ = fog.power(self.photons)
        dr.eval(self.Φ)
        self.grid = Grid(self.photons.p, in_media(self.photons), radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (4 / 3 * np.pi * radius**3 * traced.paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def light(self, x: mi.SurfaceInteraction3f, place: media.Place, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """L(x) at a vertex in a medium, behind ``depth`` edges, of paths that are not too long."""
        photons, longest = self.photons, self.max_depth - depth
        phase, seen = place.medium.phase_function(), media.in_medium(x, place)

        def one(i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            near = near & (dr.gather(mi.MediumPtr, photons.medium, j, near) == place.medium)
            near &= dr.gather(mi.UInt32, photons.depth, j, near) <= longest
            d, Φ = dr.gather(mi.Vector3f, photons.d, j, near), dr.gather(mi.Spectrum, self.Φ, j, near)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(), seen, -d, near)
            return dr.select(near, f * Φ, 0)

        zero = dr.zeros(mi.Spectrum, dr.width(depth))
        return self.K * self.grid.gather(x.p, self.radius2, active, one, zero)


@dataclass
class InBoth:
    on_surfaces: Gathering
    in_media: GatheringInMedia

    def light(self, x, place: media.Place, bsdf: mi.BSDFPtr, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        scatters = active & place.scatters
        L = self.in_media.light(x, place, depth, scatters)
        return L + self.on_surfaces.light(x, place, bsdf, depth, active & ~place.scatters)


class VPM(PPM):
    """Progressive photon mapping in media and on surfaces; no gradients.

    Plugin ``vpm``. Parameters: as for ``ppm``; the ``radius`` of the first pass is also used for photons in media.

    Biased, and consistent: the mean over passes converges to the image of ``volpath``.

    Not handled: light from infinitely far away through a medium without end, and what ``ppm`` does not handle.
    """

    follows, map_bytes = "volpath", MEDIA_MAP_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[InBoth]:
        world, max_depth = passes.world, self.limits.max_depth
        yield InBoth(Gathering(world, traced, max_depth), GatheringInMedia(world.fog, traced, max_depth))
