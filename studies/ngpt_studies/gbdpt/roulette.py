r"""Russian roulette that chooses which light paths are shifted, by the light that they bring to the camera.

A shift traces eight rays, but half of the vertices that the camera sees bring little of their pixels' light. The light
of all paths of a pass is known before shifts are traced:

    w      the light that the path has splatted
    I      the light of its pixel in this pass, without lamps seen directly
    I0     the light of the image: (mean of √I)²
    p      = min(1, 2 w / √(I I0)), and at least 0.1

The visibility of noise lies between w / I (relative to the pixel) and w / I0 (relative to the image). A path is shifted
with probability p, and its Δ counts 1 / p times, so the expected value is Δ for any p. The roulette uses its own random
numbers. It may have another p for a path than for its copy, since Δ itself (``pairs``) does not depend on p.

[Arvo and Kirk 1990, "Particle Transport and Image Synthesis", section 4]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film.splats import Splats
from data_gen.paths.camera import CameraSamples
from data_gen.samplers.bdpt.light_path import Seen
from ngpt_studies.gbdpt.light_again import Marker

# Of 1, 2, 3, 4 and 6 this has the least variance x time on four scenes
SHARE = 2.0
# Above 0, since a copy may be brighter than its path
LEAST = 0.1
# The number of vertices of a light path whose worth is kept, 8 bytes each. All later vertices are shifted.
RATED = 9


@dataclass
class Worth:
    """The light that each vertex of the light paths splats, and the pixel."""

    light: mi.Float  # ordered by depth, and for each depth by lane
    pixel: mi.UInt32
    lanes: mi.UInt32  # the number of lanes

    @classmethod
    def nothing(cls, lanes: int, longest: int) -> Worth:
        """Zero worth for ``lanes`` light paths of at most ``longest`` edges."""
        places = lanes * min(RATED, longest - 1)
        worth = cls(dr.zeros(mi.Float, places), dr.zeros(mi.UInt32, places), mi.UInt32(lanes))
        dr.make_opaque(worth)
        return worth

    def place(self, lane: mi.UInt32, depth: mi.UInt32) -> mi.UInt32:
        return (depth - 1) * self.lanes + lane

    def of(self, lane: mi.UInt32, depth: mi.UInt32) -> tuple[mi.Float, mi.UInt32, mi.Bool]:
        """The light and the pixel of these vertices, and whether they were kept."""
        kept = depth <= RATED
        place = self.place(lane, depth)
        return dr.gather(mi.Float, self.light, place, kept), dr.gather(mi.UInt32, self.pixel, place, kept), kept


@dataclass
class Rater(Marker):
    """A marker that keeps the ``worth`` of each vertex."""

    worth: Worth

    def sees(self, state: mi.UInt64, seen: Seen) -> mi.UInt64:
        lane = dr.arange(mi.UInt32, dr.width(self.ray))
        kept = (dr.max(seen.C) > 0) & (seen.y.depth <= RATED)
        place = self.worth.place(lane, seen.y.depth)
        dr.scatter(self.worth.light, dr.max(self.light(seen)), place, kept)
        dr.scatter(self.worth.pixel, seen.pixel, place, kept)
        return super().sees(state, seen)


def thresholds(camera: CameraSamples, light: mi.Color3f, splats: Splats) -> mi.Float:
    """√(I I0) for each pixel, from the ``light`` of camera paths and the light of ``splats``."""
    seen = np.array(dr.mean(light)).reshape(camera.pixels, -1)
    total = seen.mean(axis=1) + np.mean(splats.totals(), axis=0) / seen.shape[1]
    # The film drops values that are not finite, and a spectral sum may be negative.
    root = np.sqrt(np.maximum(np.nan_to_num(total, nan=0.0, posinf=0.0, neginf=0.0), 0.0))
    return mi.Float((root * root.mean()).astype(np.float32))


def survivors(
    camera: CameraSamples, worth: Worth, lane: mi.UInt32, depth: mi.UInt32, threshold: mi.Float
) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
    """Returns which vertices at ``depth`` of the light paths of ``lane`` are shifted, and 1 / p for each."""
    light, pixel, kept = worth.of(lane, depth)
    share = SHARE * light / dr.gather(mi.Float, threshold, pixel)
    p = dr.select(kept & (share < 1), dr.fmax(share, LEAST), 1)
    # Random numbers that no path uses
    u = mi.sample_tea_float32(camera.random.at(lane).next_key(), depth)
    few = dr.compress(u < p)
    return dr.gather(mi.UInt32, lane, few), dr.gather(mi.UInt32, depth, few), dr.gather(mi.Float, dr.rcp(p), few)
