r"""How a photon moves with the point that gathers it: pure functions.

A photon b is gathered at x, and its copy b' at y, the vertex of the neighbouring pixel's path. The copy's place round y
mirrors the place of b round x: a place within the radius of x, and not of y, goes to a place within the radius of y,
and not of x. Surfaces are curved, and photons lie on them, not on a plane; so it is the photon's line that moves.

    a, d        the predecessor of the photon on its light path, and the direction from there
    b̂           where that line meets the tangent plane at x
    ĉ           the mirror image of b̂ in the plane between x and y, turned by the smallest rotation into the tangent
                plane at y
    d'          from a to ĉ; what the line meets is b'
    J           dω'/dω, the ratio of the solid angles of a piece of either plane

The map from b̂ to ĉ is a rigid one, and its inverse is the same with x and y in each other's place. So shifting the
copy back gives b, on curved surfaces too.

In a medium there is no surface, so b and b' themselves are moved. Near to points x and y, in balls, b' is the mirror
image of b in the plane between them. Beside a camera ray x and y are the points of both rays at the same distance, n
and m the directions of the rays: distance, and place beside the ray, have the volume for their product, and the map
keeps the one and turns or mirrors the other. So it keeps volumes, whatever the rays.

A plane of two edges, the first along d, turns about that edge, so that it goes through the point on the other ray: the
angle between both edges stays, and both their lengths change (``about``).

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 4.3; the
mirror image: Gruson et al. 2018, "Gradient-Domain Volumetric Photon Density Estimation", section 4]
"""

from __future__ import annotations

import drjit as dr


def on_plane(b, d, x, n):
    """b̂: where the line through ``b`` along ``d`` meets the plane through ``x`` with normal ``n``."""
    return b + d * (dr.dot(x - b, n) / dr.dot(d, n))


def moved(b̂, x, n, y, m):
    """ĉ: the image, in the plane through ``y`` with normal ``m``, of a point in that through ``x`` with normal ``n``.

    Either normal may point either way; x and y differ.
    """
    across = dr.normalize(y - x)
    n = mirror(n, across)
    m = dr.select(dr.dot(n, m) < 0, -m, m)
    return y + rotate(mirror(b̂ - x, across), n, m)


def image(b, x, y):
    """b': the mirror image of ``b`` in the plane between x and y, which differ."""
    return y + mirror(b - x, dr.normalize(y - x))


def mirror(v, across):
    """``v`` mirrored in the plane whose normal is ``across``."""
    return v - across * (2 * dr.dot(v, across))


def rotate(v, n, m):
    """``v`` turned by the smallest rotation from the unit vector ``n`` to ``m``; ``m`` must not be -``n``."""
    axis, cos = dr.cross(n, m), dr.dot(n, m)
    return v * cos + dr.cross(axis, v) + axis * (dr.dot(axis, v) / (1 + cos))


def past(a, e, x, d, u, far):
    """Where a line from ``a`` passes the ray through ``x`` along ``d``, there, at the signed distance ``u``.

    ``e`` is a direction near to the line's; where the line comes from infinitely ``far`` away, ``e`` is its direction.
    """
    target = x
    # The line's direction changes the place a little. Each step reduces the error by the factor u over the length.
    for _ in range(6):
        target = x + dr.normalize(dr.cross(d, e)) * u
        e = dr.select(far, e, dr.normalize(target - a))
    return target


def about(a, d, e, y):
    """(e', s', t') with y = a + s' d + t' e': ``e``, turned about ``d`` into the half-plane of ``y``."""
    to = y - a
    along = dr.dot(to, d)
    aside = to - d * along
    distance = dr.norm(aside)
    cos = dr.dot(d, e)
    sin = dr.norm(dr.cross(d, e))
    t = distance / sin
    return d * cos + aside * (sin / distance), along - t * cos, t


def jacobian_of_planes(t, volume, t1, volume1):
    """J of a plane's second direction, as ``about`` turns it; ``t``, ``t1``: the distances along it to rays.

    ``volume``, ``volume1``: of edge, direction and ray, each of length 1.
    """
    return (t / t1) * dr.abs(volume1 / volume)


def jacobian(d, n, length2, d1, m, length2_1):
    """J of the way from a, along ``d``, to b̂ (normal ``n``), which becomes that along ``d1`` to ĉ (normal ``m``).

    ``length2``, ``length2_1``: squared distances of b̂ and ĉ from a. They are 1 for light from infinitely far away,
    whose origins move and not the directions.
    """
    return dr.abs(dr.dot(m, d1) / dr.dot(n, d)) * jacobian_in_medium(length2, length2_1)


def jacobian_in_medium(length2, length2_1):
    """J of the way from a to b, whose distance has a density of its own, which becomes that to b', of equal volumes."""
    return length2 / length2_1
