"""What is near to camera paths: the protocol by which photons, beams and planes give their differences.

A *thing* (a photon, a beam, a plane) is paired with what it is near to on a base path (a vertex, a piece of a ray), the
*receiver* A. The neighbour's path has the corresponding receiver B. A thing near to both is its own copy. If a thing is
near only to A, a copy is made near to B.
"""

from __future__ import annotations

from typing import Any, Protocol

import mitsuba as mi

from data_gen.paths.world import World
from data_gen.samplers.photons.gradients.camera import Path
from data_gen.samplers.photons.gradients.pairs import Receivers
from data_gen.samplers.photons.map.grid import Grid


class Near(Protocol):
    """The things of a photon map. All its arrays are evaluated."""

    grid: Grid | None  # in which things are found within ``radius2``; None where any may be near
    radius2: mi.Float | None

    def where(self, world: World, base: Path) -> tuple[Receivers, mi.Bool]:
        """Where base paths receive light, for the grid; and which of them do."""

    def receiver(self, world: World, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> Any:
        """What receives light of each path ``index``; of the path of number ``which``, if there are some ``paths``."""

    def thing(self, place: mi.UInt32) -> Any:
        """The thing of that place in the list of the grid. It has ``depth``, the edges of its light path."""

    def brought(self, thing: Any, A: Any, active: mi.Bool) -> tuple[mi.Spectrum, Any]:
        """C, what it brings to the camera by A, 0 where it is not near; and where they meet."""

    def shared(self, thing: Any, met: Any, B: Any, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        """What it brings by B as its own copy; and whether a copy of another place is to be looked for.

        ``met`` is where thing and A meet, ``lit`` whether it brings anything there.
        """

    def copied(self, world: World, thing: Any, A: Any, B: Any) -> tuple[mi.Spectrum, mi.Float]:
        """What its copy brings by B, 0 where there is none, and r."""
