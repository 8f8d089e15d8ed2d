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

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightRay
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.gradients.camera import Level, levels
from data_gen.samplers.photons.gradients.camera import Path as CameraPath
from data_gen.samplers.photons.gradients.differences import (
    PAIR_BYTES,
    PAIRS,
    Near,
    add_to,
    differences,
    emitted,
    gradient_pass,
)
from data_gen.samplers.photons.map.radius import shrunk
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.photons.surfaces.ppm import PPM

# Of a camera sample beside that: levels of five paths with their rays, hits and throughputs, and as many sums
PATHS_BYTES = 3072


class GPM(PPM):
    """Gradient-domain photon mapping on surfaces.

    Plugin ``gpm``. Parameters are those of ``ppm``, and

    ``diagnostics``  false; true adds the layer ``shift_failures``, the share in [0, 1] of the photons gathered at a
                     pixel that have no copy

    Not handled: what ``ppm`` does not handle. Photons that come through glass have no copies but themselves.
    """

    name = "gpm"
    pairs, camera_bytes = PAIRS, PATHS_BYTES + PAIRS * PAIR_BYTES

    def gathered(self, passes: Passes, starts: LightRay, photons, number: int, paths: int) -> Iterator:
        """What is near in the map ``photons`` of pass ``number``, of so many light paths that begin at ``starts``."""
        yield Near(starts, photons, self.radius * passes.width * shrunk(number), paths)

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """One photon map, and one camera path and its four shifts for each camera sample, of which a pixel has one."""
        gradient_pass(self, passes, camera, film)

    def levels(self, passes: Passes, random, rays: list) -> Iterator[Level]:
        """The camera paths that begin with ``rays``, level after level."""
        paths = passes.world.materials, random, rays, self.first_hit, self.hide_emitters
        return levels(passes.world.scene, *paths, self.max_depth, self.rr_depth, passes.frozen)

    def met(self, passes: Passes, level: Level, sums: list) -> mi.Spectrum:
        """What is seen directly, at the first level; emission that paths meet at others is added to the ``sums``."""
        if not level.first:
            add_to(sums, level.lanes, passes.frozen(emitted, passes.world.scene, level.base, level.offsets))
        elif self.max_depth > 0:
            return passes.frozen(CameraPath.emission, level.base, passes.world.scene, fixed=True)
        return mi.Spectrum(0)

    def parts(self, passes: Passes, near, level: Level, most: int) -> Iterator[list]:
        """Of the photons ``near`` a level's paths, the differences."""
        longest = dr.opaque(mi.UInt32, self.max_depth) - level.depth
        dr.eval(longest)
        yield from differences(passes, near, level.base, level.offsets, longest, most)


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``gpm``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "gpm", **options).prepare(scene)


mi.register_integrator("gpm", lambda props: GPM(props))
