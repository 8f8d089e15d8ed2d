"""A light that a path was connected to, seen from another vertex."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import AREA, FAR, POINT, LightEnds


def seen_from_elsewhere(
    lights: LightEnds,
    scene,
    light: mi.DirectionSample3f,
    weight: mi.Spectrum,
    si: mi.SurfaceInteraction3f,
    active,
    *,
    front,
) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.Float]:
    """A sampled ``light`` of ``weight`` Le / p shifted: the same point of the emitter, seen from ``si``.

    ``front`` is the third value of ``lights.connect()``. Returns the shifted light, the weight Le J / p with the p of
    ``light``, and p' J / p, where J = dω' / dω.
    """
    index = lights.index_of(light.emitter, active)
    kind = dr.gather(mi.UInt32, lights.kind, index, active)
    far = kind == FAR
    other = mi.DirectionSample3f(light)
    other.emitter = light.emitter  # which Mitsuba 3.9 does not copy
    to = mi.Vector3f(light.p - si.p)
    distance = dr.norm(to)
    other.d, other.dist = dr.select(far, light.d, to / distance), dr.select(far, light.dist, distance)
    other.p = dr.select(far, si.p + light.d * light.dist, light.p)
    weight, r = mi.Spectrum(weight), mi.Float(1)
    if AREA in lights.kinds:
        here = kind == AREA
        facing = dr.dot(light.n, other.d) / dr.dot(light.n, light.d)
        shines = facing > 0
        if front is not None:
            shines &= dr.dot(front, other.d) < 0
        J = dr.select(shines, facing * dr.square(light.dist / distance), 0)
        weight *= dr.select(here, J, 1)
        other.pdf = dr.select(here, dr.select(J > 0, light.pdf / J, 0), light.pdf)
        if lights.balls:
            ball = active & here & (dr.gather(mi.Float, lights.of_ball, index, active) > 0)
            other.pdf = dr.select(ball, scene.pdf_emitter_direction(si, other, ball), other.pdf)
            r = dr.select(ball, other.pdf * J / light.pdf, r)
    if POINT in lights.kinds:
        here = active & (kind == POINT)
        _, intensity = light.emitter.sample_direction(si, mi.Point2f(0.5), here)
        weight = dr.select(here, intensity / scene.pdf_emitter(index, here), weight)
    return other, weight, r
