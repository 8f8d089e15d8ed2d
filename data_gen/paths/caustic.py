"""The layer ``caustic``: the light of paths that leave a widely scattering surface and later a sharp one.

Such paths are rare and bright, and cannot be shifted well: a shifted copy meets another point of the glass, and from
there it misses the lamp. So their light goes into a separate layer, for methods that need no differences.

    rough   the path has scattered smoothly at a connectable vertex
    late    and has later left a vertex by a mirror, glass or sharp gloss: its light belongs to the layer

``rough`` and ``late`` are properties of a path, not of its shift. So primal - caustic is the image of a subset of the
paths, and dx and dy are the differences of this image. A path of the layer counts 0 in dx and dy, whether it is a base
path or a shifted copy. This is exact, because the shift is rejected from both sides if either path of a pair is late.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import DELTA, SMOOTH


def classes(rough: mi.Bool, late: mi.Bool, found: mi.Bool, kind: mi.UInt32, connectable: mi.Bool) -> tuple:
    """``rough`` and ``late`` after a vertex. ``kind`` is the kind of event by which the path left it.

    If no direction was ``found``, the path ends, and both stay as they are.
    """
    smooth = found & (kind == SMOOTH)
    sharp = (found & (kind == DELTA)) | (smooth & ~connectable)
    return rough | (smooth & connectable), late | (rough & sharp)


def lit_late(rough: mi.Bool, late: mi.Bool, connectable: mi.Bool) -> mi.Bool:
    """Whether light from a sampled emitter, scattered at this vertex, belongs to the layer."""
    # This is the rule for a direction that a smooth event has sampled, because both techniques must split the light
    # alike.
    return late | (rough & ~connectable)


def ends_late(smooth: mi.Bool, connectable: mi.Bool, sharp_next: mi.Bool) -> mi.Bool:
    """Whether all light from behind the next vertex belongs to the layer.

    It does if the next vertex has no hole and does not scatter widely, because then the path is late after any event
    there. A shifted copy of such a path would be of no use. So the shift is rejected one step before the path is late,
    again from both sides.
    """
    return smooth & connectable & sharp_next


def split(late: mi.Bool, light: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Splits ``light`` into the part outside the layer and the part in it."""
    return dr.select(late, 0, light), dr.select(late, light, 0)
