"""Shift mappings of gradient-domain path tracing: pure functions, each for one vertex.

A shift maps a base path through one pixel to an offset path through its neighbour. At each vertex the shift does one of
four things (survey, sections 3.1 to 3.3):

    reconnect   go straight to the next vertex of the base path, which both paths share from then on
    replay      sample the next direction from the same random numbers
    copy        take the direction that has the same half-vector, in the shading frame
    reject      give up: no offset path corresponds to this base path

Gradients are unbiased if the shift is an involution, T(T(x)) = x. Shifting the offset path back must give the base
path, with the inverse Jacobian; otherwise the shift must be rejected from both sides. So each rule below is symmetric,
or has a test of what the reverse shift would do.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import SMOOTH


def reconnects(kind: mi.UInt32, base: mi.Bool, base_next: mi.Bool, offset: mi.Bool) -> mi.Bool:
    """Whether the offset path goes to the base path's next vertex.

    ``kind`` is the kind of event by which the base path left its vertex. The other arguments say whether these vertices
    are connectable: the base path's, its next one, and the offset path's. An escape to the environment is connectable
    (Kettunen et al. 2015, section 5.2).
    """
    # All three vertices count, so the rule stays the same if base and offset change places.
    return (kind == SMOOTH) & base & base_next & offset


def replay_inverts(offset_kind: mi.UInt32, offset: mi.Bool, offset_next: mi.Bool, base: mi.Bool) -> mi.Bool:
    """Whether the reverse shift would undo the replay of an event.

    The reverse shift would not undo it if it reconnected the base path's vertex to the next vertex of the offset path,
    whose event is of ``offset_kind``. If it does not reconnect, it replays too, whatever the kinds of the two events,
    because the same random numbers have the same density (survey, eq. 6).
    """
    # The reverse shift applies the rule of ``reconnects`` with the two paths exchanged.
    return ~reconnects(offset_kind, offset, offset_next, base)


def keeps_joined(kind: mi.UInt32) -> mi.Bool:
    """Whether a path that has come to the shared vertex from another direction may leave it as its companion does.

    It may if the event at the shared vertex is smooth. A mirror or a hole gives each incoming direction its own
    outgoing one, so neither path can sample the other's direction, and the shift is rejected from both sides.
    """
    return kind == SMOOTH


def reconnection_jacobian(
    base: mi.Point3f, offset: mi.Point3f, target: mi.Point3f, normal: mi.Normal3f, in_medium: mi.Bool | None = None
) -> mi.Float:
    """dω'/dω, for directions from ``base`` and from ``offset`` to the same ``target`` with geometric ``normal``.

    It is (cos θ' / cos θ) (d² / d'²), with angles at the target (survey, section 3.3). In a medium, where the distance
    has its own density, it is d² / d'² (survey, section 7.1).
    """
    to_base, to_offset = base - target, offset - target
    near, far = dr.squared_norm(to_base), dr.squared_norm(to_offset)
    # A ratio of cosines times a ratio of squared distances. The cubes of distances could leave the range of float32.
    cosines = dr.abs(dr.dot(normal, to_offset) / dr.dot(normal, to_base)) * dr.sqrt(near / far)
    if in_medium is not None:
        cosines = dr.select(in_medium, 1, cosines)
    return cosines * (near / far)


def copy_half_vector(
    wi: mi.Vector3f, wo: mi.Vector3f, η: mi.Float, wi_offset: mi.Vector3f, same: mi.Bool
) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Returns the direction whose half-vector with ``wi_offset`` is that of ``wi`` and ``wo``; dω'/dω; and whether it
    exists.

    Directions are in the shading frame of their vertex and lead away from it. ``η`` is the relative index of refraction
    along ``wo``. A refraction is copied only to the ``same`` material from the same side, since the reverse shift must
    know η. A transmission without bending (thin sheets) is copied as a mirrored reflection. The event at the base
    vertex must not be a Dirac delta. [Kettunen et al. 2015, supplement; Walter et al. 2007, eq. 13-17, 40]
    """
    refracts = wi.z * wo.z < 0
    thin = refracts & (η == 1)
    bends = refracts & ~thin

    # The base path's half-vector h = (wi + η wo) / |wi + η wo| (survey, eq. 15; Walter et al., eq. 13 and 16)
    above = mi.Vector3f(wo.x, wo.y, dr.select(thin, -wo.z, wo.z))
    scale = dr.select(bends, η, 1)
    h = wi + scale * above
    length2 = dr.squared_norm(h)
    h = h * dr.rsqrt(length2)

    # Reflection about h; the sign of h does not matter
    c = dr.dot(wi_offset, h)
    mirrored = 2 * c * h - wi_offset
    # Refraction: wi' + η wo' is to be parallel to h (Walter et al., eq. 40).
    cos2 = 1 - (1 - dr.square(c)) / dr.square(scale)
    bent = (c * h - wi_offset) / scale - dr.mulsign(dr.safe_sqrt(cos2), c) * h
    wo_offset = dr.select(bends, bent, mirrored)

    # dω'/dω = (dh/dω) / (dh'/dω'), since h' = h (Walter et al., eq. 14 for reflections, eq. 17 for refractions)
    length2_offset = dr.squared_norm(wi_offset + scale * wo_offset)
    cosines = dr.abs(dr.dot(wo_offset, h) / dr.dot(above, h))
    J = dr.select(bends, length2_offset / length2 / cosines, cosines)
    wo_offset.z = dr.select(thin, -wo_offset.z, wo_offset.z)
    exists = ((wi_offset.z * wo_offset.z < 0) == refracts) & (~refracts | (same & (wi.z * wi_offset.z > 0)))
    # If the pair wi, wo is not a refraction about h, the copy has no inverse.
    exists &= (~bends | ((cos2 > 0) & (dr.dot(wi, h) * dr.dot(wo, h) < 0))) & dr.isfinite(J) & (J > 0)
    return dr.select(exists, wo_offset, mi.Vector3f(0, 0, 1)), dr.select(exists, J, 0), exists
