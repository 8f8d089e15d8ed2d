r"""The radius within which photons are gathered. It is given in pixels, and shrinks from pass to pass.

Pass i, counted from 1, gathers within r_i, with r_(i+1)^d = r_i^d (i + α) / (i + 1). d is the dimension in which
photons are gathered: 2 for disks, 3 for balls. α is ``ALPHA``. So r^d falls like i^(α - 1). The variance of the mean
over passes goes to zero like i^-α, and its bias like r², that is i^(2 (α - 1) / d). Passes are independent, and no
statistics are kept for points (Knaus and Zwicker 2011, "Progressive Photon Mapping: A Probabilistic Approach", eq. 15
and 24).

Beyond the edge of a surface there are no photons. So the light at a point x also depends on the area of the surfaces in
the disk of radius r about x.

    A           area of the surfaces within radius r of x from which photons are gathered
    w           weight of a probe, which is a line normal to the disk: 1 / cos where it meets such a surface, else 0.
                Its mean is A / (π r²)

If the light of photons were divided by π r², a uniformly lit surface would be too dark along its edges, in proportion
to r. Dividing by A gives the right light. An unbiased estimate of π r² / A is the sum of the products
(1 - w₁) ... (1 - wₖ) over k = 0, 1, ... On a plane every w is 1, so only the term for k = 0 is left, and the sum needs
one probe.

The place and the pass determine the random numbers of the probes. So in each pass the estimate depends only on x, not
on the path that leads to x.

[the sum: Booth 2007, "Unbiased Monte Carlo Estimation of the Reciprocal of an Integral"]
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.light_ends import World
from data_gen.samplers.photons.map.vertices import NORMAL_COSINE

ALPHA = 2 / 3


def shrunk(i: int, dimension: int = 2) -> float:
    """Returns the radius of pass ``i`` divided by the radius of the first pass, which has i = 0 here. Photons are
    gathered in a disk (``dimension`` 2) or a ball (3).
    """
    # The product of (k + α) / (k + 1) over k = 1 .. i, computed by the Gamma function
    log_ratio = math.lgamma(i + 1 + ALPHA) - math.lgamma(1 + ALPHA) - math.lgamma(i + 2)
    return math.exp(log_ratio / dimension)


def pixel_width(scene: mi.Scene, sensor: mi.Sensor) -> float:
    """The width of a pixel of ``sensor`` at the surfaces it sees, in world units: the median over the image.

    It is a thousandth of the scene's diagonal if the camera sees nothing, or has no adjacent rays.
    """
    camera = CameraSamples(sensor, 0, 1)
    ray, _, _ = camera.rays()
    depth = features(scene, camera.sensor, camera.random.clone(), ray)["depth"]
    # For a perspective camera Mitsuba 3.9 starts the neighbour's ray at the start of this ray, on the near plane.
    fans = dr.squared_norm(ray.d_x - ray.d) > 0
    aside = dr.select(fans, dr.norm(ray.d_x - ray.d) * depth, dr.norm(ray.o_x - ray.o))
    dr.eval(depth, aside)
    seen = (np.array(depth) > 0) & ray.has_differentials
    box = scene.bbox()
    wide = np.median(np.array(aside)[seen]) if seen.any() else 1e-3 * np.linalg.norm(np.array(box.extents()))
    return float(wide)


# The most rays for a point. Objects much narrower than the radius would need more rays, and stay a bit too dark.
RAYS = 24
# The sum ends at a term that is smaller than this.
LEAST = 0.01
# Points are rounded to places, this number per radius. So points that differ only by rounding errors usually get the
# same random numbers.
PLACES = 8
# Rounds of the hash. With 4, Mitsuba's default, the probes of a point are correlated, and all of them may miss.
ROUNDS = 8


def number_of(seed: int, number: int) -> mi.UInt32:
    """A number that differs for each pass ``number`` and each ``seed``."""
    return dr.opaque(mi.UInt32, (seed * 0x9E3779B1 + number * 0x85EBCA77) % (1 << 32))


@dr.syntax
def spread(world: World, x: mi.SurfaceInteraction3f, radius2: mi.Float, number: mi.UInt32, active: mi.Bool) -> mi.Float:
    """Estimates π r² / A at vertices ``x`` where light is gathered; ``number`` is from ``number_of()``."""
    scene, receives = world.scene, world.materials.connectable
    frame, n = mi.Frame3f(x.n), mi.Vector3f(x.n)
    radius = dr.sqrt(radius2)
    place = [mi.UInt32(mi.Int32(dr.round(q * (PLACES / radius)))) for q in x.p]
    other, _ = mi.sample_tea_32(place[1], place[2], ROUNDS)
    place, _ = mi.sample_tea_32(place[0] ^ number, other, ROUNDS)
    total, term, rays = mi.Float(0), mi.Float(1), mi.UInt32(0)
    # The part of a probe that is not traced yet, and whether a new probe begins
    ray, begins = mi.Ray3f(x.p, -n, dr.zeros(mi.Float), x.time, x.wavelengths), mi.Bool(True)
    going = mi.Bool(active)
    while dr.hint(going, label="probes of edges"):
        if begins:
            total += term
            u, v = mi.sample_tea_32(place, rays, ROUNDS)
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u >> 8, v >> 8) * 2.0**-24)
            half = dr.sqrt(radius2 * dr.maximum(1 - dr.squared_norm(disk), 0))
            ray.o = x.p + frame.to_world(mi.Vector3f(disk.x, disk.y, 0)) * radius + n * half
            ray.maxt = 2 * half
        si = scene.ray_intersect(ray, going)
        found = going & si.is_valid()
        cos = dr.dot(si.n, n)
        meets = found & (cos > NORMAL_COSINE) & receives(si.bsdf())
        term = dr.select(meets, term * (1 - dr.rcp(cos)), term)
        begins = meets | ~found
        left = ray.maxt - si.t
        ray.o = dr.select(begins, ray.o, si.spawn_ray(ray.d).o)
        ray.maxt = dr.select(begins, ray.maxt, left)
        rays += 1
        going &= (rays < RAYS) & (dr.abs(term) > LEAST)
    return dr.select(active, total, 1)
