"""Which vertex of the light path a vertex of the camera path is connected to: one of all, chosen by its likely worth.

Connections to all of them would take half the time of a sample, most of it for little light. One, its light divided by
the probability of the choice, has the same mean: weights of strategies stay as they are. The better the guess of what
each connection brings, the less noise this adds; the guess reads what is kept of the light path and nothing else, no
material and no ray.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.light_path import LightPath
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.vertex import Vertex, cosine

# Added to cosines: shading normals light what geometric ones do not, and gloss is not matte.
_LEAST_COSINE = 0.1


@dr.syntax
def choose(z: Vertex, active, light: LightPath, longest: int, u: mi.Float):
    """The number of the chosen vertex of ``light``, and 1 / the probability of that choice; 0 where there is none.

    Vertices that paths of at most ``longest`` edges lead to can be chosen, by the random number ``u``.
    """
    kept, end = light.kept, dr.minimum(light.count, longest - 1 - z.depth)
    come_from = cosine(z.si, z.si.to_world(z.si.wi))
    i = mi.UInt32(0)  # the vertex that is looked at
    chosen = mi.UInt32(0)  # one of those before it, each with a probability in proportion to its worth
    total, own = mi.Float(0), mi.Float(0)  # their worth, and the worth of the chosen one
    while dr.hint(active & (i < end), label="choice"):
        w = worth(z, come_from, kept.read(i))
        total += w
        share = w / total
        taken = (w > 0) & (u < share)
        # What is left of the random number is one again.
        u = dr.select(taken, u / share, (u - share) / (1 - share))
        u = dr.select(dr.isfinite(u), u, 0)
        chosen = dr.select(taken, i, chosen)
        own = dr.select(taken, w, own)
        i += 1
    return chosen, dr.select(own > 0, total / own, 0)


def worth(z: Vertex, come_from: mi.Float, y) -> mi.Float:
    """The light of ``z`` connected to the record ``y`` times its MIS weight, were both surfaces white and matte.

    ``come_from`` is the cosine at ``z`` of the direction that its path has come from.
    """
    to = mi.Vector3f(y.o + y.d * y.t - z.si.p)
    distance2 = dr.squared_norm(to)
    d = to * dr.rsqrt(distance2)
    cos_z, cos_y = cosine(z.si, d), dr.abs(dr.dot(y.n, d))
    side_z = mis.Side(cos_z, cos_z / dr.pi, come_from / dr.pi)
    side_y = mis.Side(cos_y, cos_y / dr.pi, dr.abs(dr.dot(y.n, y.d)) / dr.pi)
    others = mis.others_connected(z.end, Partial(y.vcm, y.vc), mis.Edge(side_z, side_y, distance2))
    w = dr.max(y.β) * (cos_z + _LEAST_COSINE) * (cos_y + _LEAST_COSINE) / (distance2 * (1 + others))
    return dr.select((y.depth > 0) & dr.isfinite(w), w, 0)
