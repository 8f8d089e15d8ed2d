"""Segments through media whose density varies (grids): null collisions, and how a shift maps them.

In a grid the transmittance can only be estimated. So a path consists not only of its vertices, but also of null
collisions on its way, which change nothing. All collisions together, null and real, occur at the rate of the majorant
μ, an upper bound of the extinction σ = μ - σn. In this larger path space all densities are known. Let M be the
majorant's optical depth of the segment, in its grids only. Then n null collisions with a vertex at the end have the
density exp(-M) ∏ σn(x_i) / μ · σ. The integrand has the scattering coefficient σs in place of σ, and one value for each
colour. The distances between collisions, in optical depths m of the majorant, are exponentially distributed; m
continues through all grids and gaps that the segment crosses. A replay takes the same steps and random numbers: r = 1.
A reconnection moves the collisions of the base path, m_i' = m_i M' / M, with the Jacobian (M' / M)^n. The steps are
generated again from the base path's key, so only n has to be kept. Homogeneous media use one exponential number for
each segment, and no null collisions.

[Miller et al. 2019, "A null-scattering path integral formulation of light transport"; docs/samplers/media.md]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.media import beyond, end_of, onward, pick


@dataclass
class Collisions:
    key: mi.UInt32  # of the random numbers that determine their places
    n: mi.UInt32
    M: mi.Float
    N_c: mi.Float  # the product of σn / μ in colour c


def number(key: mi.UInt32, i: mi.UInt32) -> mi.Float:
    """The ``i``-th random number of a segment."""
    return mi.sample_tea_float32(key, i, 4)


def step(key: mi.UInt32, i: mi.UInt32) -> mi.Float:
    """The majorant's optical depth between collision ``i`` of a segment and the one before."""
    return -dr.log(1 - number(key, 2 * i))


def is_real(key: mi.UInt32, i: mi.UInt32, probability: mi.Float) -> mi.Bool:
    return number(key, 2 * i + 1) < probability


def extent(medium: mi.MediumPtr, ray: mi.Ray3f) -> tuple[mi.Spectrum, mi.Bool, mi.Float, mi.Float]:
    """μ of ``medium``, whether it is a grid, and the distances at which the ray enters and leaves it."""
    exists = medium != None  # noqa: E711 - a comparison of arrays of pointers
    where = dr.zeros(mi.MediumInteraction3f, dr.width(ray.o))
    where.p, where.wavelengths = ray.o, ray.wavelengths
    μ = mi.Spectrum(dr.select(exists, medium.get_majorant(where), 0))
    grid = exists & ~medium.is_homogeneous()
    # Outside of its box a grid is empty.
    met, near, far = medium.intersect_aabb(ray)
    return μ, grid, dr.select(grid & met, dr.maximum(near, 0), 0), dr.select(grid, dr.select(met, far, 0), dr.inf)


@dataclass
class Stop:
    """Where a path stops on a piece of a ray: at a collision of the majorant in a grid, or at the end of the piece."""

    t: mi.Float
    grid: mi.Bool  # whether the medium is one
    collides: mi.Bool
    passed: mi.Float  # the majorant's optical depth up to ``t``, in grids
    null: mi.Spectrum  # σn / σn_c at ``t``, if the collision is null
    real: mi.Spectrum  # the probability that it is real


def next_stop(ray, length: mi.Float, medium, channel, ahead: mi.Float, active) -> Stop:
    """The next stop on a piece of a ray of that ``length``; ``ahead`` is the optical depth to the next collision."""
    μ, grid, near, far = extent(medium, ray)
    grid, μ_c = active & grid, pick(μ, channel)
    end = dr.minimum(length, far)
    t = dr.select(grid & (μ_c > 0), near + ahead / μ_c, dr.inf)
    collides = grid & (t < end)
    stop = dr.select(collides, t, length)
    null, real = null_and_real(medium, ray, t, μ_c, collides)
    null_c, passed = pick(null, channel), dr.select(grid, μ_c * dr.maximum(dr.minimum(stop, end) - near, 0), 0)
    return Stop(stop, grid, collides, passed, dr.select(null_c > 0, null / null_c, 0), real)


def null_and_real(medium, ray, t, μ_c, active) -> tuple[mi.Spectrum, mi.Spectrum]:
    """σn / μ_c and σ / μ_c at distance ``t``."""
    where = dr.zeros(mi.MediumInteraction3f, dr.width(t))
    where.t, where.p, where.wavelengths, where.medium = t, ray(t), ray.wavelengths, medium
    _, σn, σ = medium.get_scattering_coefficients(where, active)
    return mi.Spectrum(dr.select(active, σn / μ_c, 1)), mi.Spectrum(dr.select(active, σ / μ_c, 0))


@dr.syntax
def fly_on(passes, trace, ray, medium, *, channel, u, key, active):
    """As ``segments.fly_on()``, for scenes with grids. Returns the same, then the null collisions, and ∏ σn / σn_c."""
    lanes = dr.width(ray.o)
    ray, medium = mi.Ray3f(ray), mi.MediumPtr(medium)
    left, ahead, n = -dr.log(1 - u), step(key, mi.UInt32(0)), mi.UInt32(0)
    τ, N, M = dr.zeros(mi.Spectrum, lanes), dr.full(mi.Spectrum, 1, lanes), mi.Float(0)
    hit = dr.zeros(mi.PreliminaryIntersection3f, lanes)
    μ, grid, t, far = dr.zeros(mi.Spectrum, lanes), mi.Bool(False), mi.Float(0), mi.Float(0)
    flying, scatters, fresh = mi.Bool(active), mi.Bool(False), mi.Bool(True)
    while dr.hint(flying, label="segment"):
        # -------------------------- A piece --------------------------
        if fresh:
            hit = trace(ray, medium, mi.Bool(True))
            μ, grid, t, far = extent(medium, ray)
        μ_c = pick(μ, channel)
        end = dr.minimum(dr.minimum(hit.t, far), end_of(ray))
        collision = dr.select(μ_c > 0, t + dr.select(grid, ahead, left) / μ_c, dr.inf)
        collides = collision < end
        stop = dr.select(collides, collision, end)
        # A piece is infinite only where μ is 0
        τ += mi.Spectrum(dr.select(grid | (μ <= 0), 0, μ * (stop - t)))
        passed = dr.select(μ_c > 0, μ_c * dr.maximum(stop - t, 0), 0)
        M += dr.select(grid, passed, 0)
        left, ahead = left - dr.select(grid, 0, passed), ahead - dr.select(grid, passed, 0)
        t = mi.Float(stop)

        # ------------------------ A collision ------------------------
        null, real = null_and_real(medium, ray, t, μ_c, collides & grid)
        scatters = collides & (~grid | is_real(key, n, pick(real, channel)))
        skips = collides & ~scatters
        N *= dr.select(skips, null, 1)
        n = dr.select(skips, n + 1, n)
        ahead = dr.select(skips, step(key, n), ahead)
        hit.t, hit.valid = dr.select(scatters, t, hit.t), hit.valid | scatters

        # ------------------------ A boundary -------------------------
        fresh = ~collides & hit.is_valid() & passes(hit.shape)
        flying &= skips | fresh
        if flying & fresh:
            ray, medium = beyond(ray, hit, medium)
    N_c = pick(N, channel)
    return ray, hit, medium, scatters, τ, Collisions(key, n, M, N_c), N / N_c


@dr.syntax
def cross(passes, trace, ray, medium, reach, *, channel, key, scale, most, target, active):
    """As ``segments.cross()``, for scenes with grids: at most ``most`` collisions, with steps multiplied by ``scale``.

    Returns the same, where τ is the optical depth of homogeneous media only, then M and ∏ σn / μ_c.
    """
    lanes = dr.width(ray.o)
    ray, medium, reach = mi.Ray3f(ray), mi.MediumPtr(medium), mi.Float(reach)
    ahead, n = scale * step(key, mi.UInt32(0)), mi.UInt32(0)
    τ, N, M = dr.zeros(mi.Spectrum, lanes), dr.full(mi.Spectrum, 1, lanes), mi.Float(0)
    hit = dr.zeros(mi.PreliminaryIntersection3f, lanes)
    μ, grid, t, far = dr.zeros(mi.Spectrum, lanes), mi.Bool(False), mi.Float(0), mi.Float(0)
    crossing, fresh = mi.Bool(active), mi.Bool(True)
    while dr.hint(crossing, label="transmittance"):
        if fresh:
            hit = trace(ray, medium, mi.Bool(True))
            μ, grid, t, far = extent(medium, ray)
        μ_c = pick(μ, channel)
        end = dr.minimum(dr.select(hit.is_valid(), hit.t, reach), far)
        collision = dr.select(grid & (μ_c > 0) & (n < most), t + ahead / μ_c, dr.inf)
        collides = collision < end
        stop = dr.select(collides, collision, end)
        τ += mi.Spectrum(dr.select(grid | (μ <= 0), 0, μ * (stop - t)))
        passed = dr.select(grid & (μ_c > 0), μ_c * dr.maximum(stop - t, 0), 0)
        M, ahead = M + passed, ahead - passed
        t = mi.Float(stop)
        null, _ = null_and_real(medium, ray, t, μ_c, collides)
        N *= null
        n = dr.select(collides, n + 1, n)
        ahead = dr.select(collides, scale * step(key, n), ahead)
        fresh = ~collides & hit.is_valid() & passes(hit.shape)
        crossing &= collides | fresh
        # Where the product N is 0, the transmittance is 0, and the rest of the segment does not matter.
        crossing &= dr.max(N) > 0
        if crossing & fresh:
            ray, medium, reach = onward(ray, hit, medium, reach, target)
    return τ, hit, ray, medium, M, N


def rescale(
    passes, trace, ray, medium, reach, base: Collisions, *, channel, active, target=None, to_surface: bool = False
) -> tuple:
    """Maps the null collisions of a ``base`` segment to another segment: m_i' = m_i M' / M.

    Unless ``to_surface`` is set, a segment that ends at a surface is blocked, and nothing is mapped. Returns τ of
    homogeneous media, the hit, the last piece of the ray, the medium there, and the integrand of the mapped collisions
    times the Jacobian, divided by the density of the base collisions. The last value is colour c of this quotient,
    which is the ratio of the densities.
    """
    way = {"channel": channel, "key": base.key, "target": target}
    # The first crossing has no collisions; it only measures M'.
    none, one = mi.UInt32(0), mi.Float(1)
    τ, hit, last, end, M, N = cross(passes, trace, ray, medium, reach, **way, scale=one, most=none, active=active)
    scale = M / base.M
    moved = active & (base.n > 0) & (to_surface | ~hit.is_valid())

    def placed():
        return cross(passes, trace, ray, medium, reach, **way, scale=scale, most=base.n, active=mi.Bool(True))[-1]

    (N,) = dr.if_stmt((N,), moved, lambda N: (placed(),), lambda N: (N,))
    N *= dr.exp(base.M - M) * dr.select(base.n > 0, dr.power(scale, mi.Float(base.n)), 1) / base.N_c
    return τ, hit, last, end, N, pick(N, channel)
