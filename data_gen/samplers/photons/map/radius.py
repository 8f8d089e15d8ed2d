r"""The radius within which photons are gathered. It is given in pixels, and shrinks from pass to pass.

Pass i gathers within r_i, with r_(i+1)^d = r_i^d (i + α) / (i + 1); d is 2 on surfaces and 3 in media, the dimension of
what photons are counted in. So r^d falls like i^(α - 1): slowly enough that the noise of the mean over passes goes to
zero like i^-α, and its bias like r², i^(2 (α - 1) / d). Every pass is on its own, no point keeps statistics (Knaus and
Zwicker 2011, "Progressive Photon Mapping: A Probabilistic Approach", eq. 15 and 24).

The share of surface in the disk about a point also matters, since no photons lie beyond the edge of a surface.

    A           area of the surfaces within radius r of x that photons are gathered from
    w           of a probe: 1 / cos where a line through the disk, normal to it, meets such a surface; 0 where it does
                not; its mean is A / (π r²)

If photons were counted over π r², uniform light on a surface would be too dark along the edges, in proportion to r.
Counted over A, it is right. π r² / A is the sum of the products (1 - w₁) ... (1 - wₖ) over k from 0 on, whose mean is
right, and which has one term on a plane: one probe for each point.

The place and the pass determine the probes' random numbers. So π r² / A is a property of x in each pass, by whatever
path it is reached.

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
    """r_i / r_0, i from 0, where photons are counted in a disk, or in a ball (``dimension`` 3)."""
    # The product of (k + α) / (k + 1) over k = 1 .. i, by the Gamma function
    log_ratio = math.lgamma(i + 1 + ALPHA) - math.lgamma(1 + ALPHA) - math.lgamma(i + 2)
    return math.exp(log_ratio / dimension)


def pixel_width(scene: mi.Scene, sensor: mi.Sensor) -> float:
    """The width of a pixel of ``sensor`` at the surfaces it sees, in world units: the median over the image.

    A thousandth of the scene's diagonal where the camera sees nothing, or has no adjacent rays.
    """
    camera = CameraSamples(sensor, 0, 1)
    ray, _, _ = camera.rays()
    depth = features(scene, camera.sensor, camera.random.clone(), ray)["depth"]
    # With a perspective camera Mitsuba 3.9 begins the neighbour's ray where this one begins, on the near plane.
    fans = dr.squared_norm(ray.d_x - ray.d) > 0
    aside = dr.select(fans, dr.norm(ray.d_x - ray.d) * depth, dr.norm(ray.o_x - ray.o))
    dr.eval(depth, aside)
    seen = (np.array(depth) > 0) & ray.has_differentials
    box = scene.bbox()
    wide = np.median(np.array(aside)[seen]) if seen.any() else 1e-3 * np.linalg.norm(np.array(box.extents()))
    return float(wide)


# Rays for a point: narrow things keep some of the loss, as long as they are much narrower than the radius.
RAYS = 24
# A term that is less ends the sum.
LEAST = 0.01
# In radii: points so near to each other get the same numbers, however they were rounded.
PLACES = 8
# Rounds of the hash: with Mitsuba's 4, one probe after another misses.
ROUNDS = 8


def number_of(seed: int, number: int) -> mi.UInt32:
    """A number that differs for each pass ``number`` and each ``seed``."""
    return dr.opaque(mi.UInt32, (seed * 0x9E3779B1 + number * 0x85EBCA77) % (1 << 32))


@dr.syntax
def spread(world: World, x: mi.SurfaceInteraction3f, radius2: mi.Float, number: mi.UInt32, active: mi.Bool) -> mi.Float:
    """π r² / A at vertices ``x`` where light is gathered; ``number`` is the pass's, see ``number_of()``."""
    scene, receives = world.scene, world.materials.connectable
    frame, n = mi.Frame3f(x.n), mi.Vector3f(x.n)
    radius = dr.sqrt(radius2)
    place = [mi.UInt32(mi.Int32(dr.round(q * (PLACES / radius)))) for q in x.p]
    other, _ = mi.sample_tea_32(place[1], place[2], ROUNDS)
    place, _ = mi.sample_tea_32(place[0] ^ number, other, ROUNDS)
    total, term, rays = mi.Float(0), mi.Float(1), mi.UInt32(0)
    # What is left of a probe
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
