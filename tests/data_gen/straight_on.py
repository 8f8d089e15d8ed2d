"""Mitsuba's ``path``, whose rays toward lamps go straight on through masks and panes: written apart from our samplers.

Each hole counts in ``max_depth``. Without a limit, and where something is behind all that has holes, it has the image
of ``volpath``, which a test holds it to.
"""

from functools import cache

import drjit as dr
import mitsuba as mi


@cache
def straight_on(variant):
    """The class of the integrator; Mitsuba's classes belong to a variant."""

    class StraightOn(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.max_depth, self.rr_depth = props["max_depth"] & 0xFFFFFFFF, props["rr_depth"]

        @dr.syntax
        def sample(self, scene, sampler, ray, medium=None, active=True):
            ray, active, context = mi.Ray3f(ray), mi.Bool(active), mi.BSDFContext()
            L, β, η, depth = mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), mi.UInt32(0)
            # The last vertex that was no hole, and the density of the direction there; infinite behind mirrors
            last, p = dr.zeros(mi.Interaction3f), mi.Float(dr.inf)
            while active:
                si = scene.ray_intersect(ray, active)
                light = mi.DirectionSample3f(scene, si, last)
                p_light = scene.pdf_emitter_direction(last, light, active & dr.isfinite(p))
                m = dr.select(dr.isfinite(p), p / (p + p_light), 1)
                L += β * m * light.emitter.eval(si, active)
                depth += 1
                active &= si.is_valid() & (depth < self.max_depth)

                bsdf = si.bsdf(ray)
                light, Le = scene.sample_emitter_direction(si, sampler.next_2d(), False, active)
                wo = si.to_local(light.d)
                f, p_bsdf = bsdf.eval_pdf(context, si, wo, active)
                m = dr.select(light.delta, 1, light.pdf / (light.pdf + p_bsdf))
                C = β * f * Le * m
                C = mi.Spectrum(dr.select(active & (light.pdf > 0) & dr.isfinite(dr.sum(C)), C, 0))
                shadow, count, going = si.spawn_ray_to(light.p), mi.UInt32(depth), dr.max(C) > 0
                while going:
                    there = scene.ray_intersect(shadow, going)
                    going &= there.is_valid()
                    count += 1
                    T = there.bsdf().eval_null_transmission(there, going)
                    C = dr.select(going, mi.Spectrum(C * dr.select(count < self.max_depth, T, 0)), C)
                    going &= dr.max(C) > 0
                    shadow = there.spawn_ray_to(light.p)
                L += C

                sample, f_p = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
                hole = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
                smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Smooth)
                last.p = dr.select(hole, last.p, si.p)
                p = dr.select(hole, p, dr.select(smooth, sample.pdf, dr.inf))
                β = mi.Spectrum(β * f_p)
                η *= sample.eta
                q = dr.select(depth >= self.rr_depth, dr.minimum(dr.max(β) * dr.square(η), 0.95), 1)
                active &= (sampler.next_1d() < q) & (dr.max(β) > 0)
                β = mi.Spectrum(β * dr.rcp(q))
                ray = si.spawn_ray(si.to_world(sample.wo))
            return L, mi.Bool(True), []

    return StraightOn


def integrator(mi, max_depth=-1, rr_depth=5):
    props = mi.Properties("straight_on")
    props["max_depth"], props["rr_depth"] = max_depth, rr_depth
    return straight_on(mi.variant())(props)
