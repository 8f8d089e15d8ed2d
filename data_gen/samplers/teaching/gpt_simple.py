r"""A simple gradient-domain path tracer for readers who want to understand ``gpt``. Reconnection is its only shift.

It renders scenes whose materials all scatter widely. In such scenes an offset path always goes straight from its own
first vertex to the second vertex of its base path, so the code for the first two steps has no loop. The other
techniques of ``gpt`` (replay, half-vectors, ghosts, shared emitters, specialised kernels) are left out. Functions and
symbols (x, y, L, Le, β, J, p, r, w, m, Δ, a) are as in ``data_gen.samplers.gpt.integrator``, so both files can be read
side by side.

At the first vertex an offset path is *apart* from its base path. At the second vertex it is *joined*: both paths share
this vertex, but arrive from different directions. From the third vertex on it is *settled*: base and offset path are
the same. R is the radiance that arrives from the third vertex on.

The density ratio of the two paths, r, is set to 0 when a shift is rejected. A rejected path needs no extra code: its
throughput and r are 0. The formulas then give w = 1 and Δ = -2 C(x) / p(x), as they should. Here C(x) is the
contribution of base path x; the 2 is explained at ``data_gen.paths.mis.gradient_weight``.

[Kettunen et al. 2015, "Gradient-Domain Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering",
sections 3.3, 3.5 and 4.1]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.lights import LightSample, emission, sample_light
from data_gen.paths.mis import gradient_weight, mis_weight
from data_gen.paths.shift import reconnection_jacobian
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import Materials, consistent, evaluate, seen_from
from data_gen.paths.walk import Limits, roulette
from data_gen.samplers.common import GradientIntegrator, recorded
from data_gen.samplers.shared import CONNECTABLE
from ngpt.errors import NgptError


class GPTSimple(GradientIntegrator):
    """Gradient-domain path tracing with reconnection only, for surfaces that scatter widely.

    Plugin ``gpt_simple``. Parameters, as for Mitsuba's ``path``: ``max_depth`` (default -1: no limit) and ``rr_depth``
    (5; Russian roulette never starts before the third vertex).

    Not handled: mirrors, glass, rough materials of very low roughness (polish), holes, media, hidden emitters and
    polarised variants. Rendering a scene with any of these raises NgptError.
    """

    def sample(self, scene, sampler, ray, medium=None, active=True):
        L, Le, _ = trace(scene, self.limits, sampler, ray, mi.Spectrum(1), [])
        return L + Le, mi.Bool(True), []

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        refuse(scene)
        return recorded(scene, partial(self.samples, scene), shifts=SHIFTS.values())

    def samples(self, scene, camera: CameraSamples) -> dict:
        """One base path and its four offset paths for each camera sample."""
        ray, importance, _ = camera.rays()
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        L, Le, Δ = trace(scene, self.limits, camera.random.clone(), ray, importance, shifted)
        layers = {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        for name, value, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
            layers[name] = (to_rgb(value, ray.wavelengths), inside)
        return layers | features(scene, camera.sensor, camera.random.clone(), ray)


def trace(scene, limits: Limits, random, ray, importance, shifted):
    """Returns L, Le and the four Δ (in the order of SHIFTS) of base paths that begin with ``ray``."""
    # ------------------ First vertex: offset paths are apart ------------------
    x = scene.ray_intersect(mi.Ray3f(ray))
    Le = importance * x.emitter(scene).eval(x, limits.max_depth > 0)
    active = x.is_valid() & (limits.max_depth > 1)
    offsets = [start(scene, active, *ray_and_importance) for *ray_and_importance, _ in shifted]
    step = base_step(scene, random, x, importance, active)
    L = step.β * step.L_light + step.β1 * step.L_bsdf
    offsets = [step_apart(scene, step, y) for y in offsets]

    # ---------------- Second vertex: offset paths are joined ------------------
    step = base_step(scene, random, step.x1, step.β1, step.x1.is_valid() & (limits.max_depth > 2))
    L += step.β * step.L_light + step.β1 * step.L_bsdf
    settled = [step_joined(step, y) for y in offsets]

    # ------------ From the third vertex on: one path, so one radiance ---------
    R = walk(scene, limits, random, step.x1)
    return L + step.β1 * R, Le, [Δ + a * R for Δ, a in settled]


@dr.syntax
def walk(scene, limits: Limits, random, x):
    """Returns R, the radiance that reaches the second vertex from the third vertex ``x``."""
    R, β, depth = mi.Spectrum(0), mi.Spectrum(1), mi.UInt32(3)
    active = x.is_valid() & (depth < limits.max_depth)
    while dr.hint(active, label="gpt_simple"):
        step = base_step(scene, random, x, β, active)
        R += β * step.L_light + step.β1 * step.L_bsdf
        # Roulette uses the throughput since the second vertex. All five paths share it, so roulette suits each of them.
        q = roulette(dr.max(step.β1), depth >= limits.rr_depth)
        survives = random.next_1d() < q
        x, β = step.x1, step.β1 / q
        depth += 1
        active = survives & x.is_valid() & (depth < limits.max_depth)
    return R


@dataclass
class Step:
    """A step of the base path from its current vertex x to the next vertex x1."""

    x: mi.SurfaceInteraction3f
    β: mi.Spectrum
    # Emitter sampling
    u_light: mi.Point2f
    light: LightSample
    L_light: mi.Spectrum  # f m Le V / p
    # BSDF sampling
    wo: mi.Vector3f
    p: mi.Float
    goes_on: mi.Bool  # whether the path continues, to a next vertex or out of the scene
    β1: mi.Spectrum  # β f / p
    x1: mi.SurfaceInteraction3f
    Le: mi.Spectrum  # the radiance emitted at x1 toward x
    p_light: mi.Float  # density with which emitter sampling would have found x1
    L_bsdf: mi.Spectrum  # m Le
    smooth: mi.Bool  # whether the scattering event is neither at a mirror nor a pass through a hole
    hole: mi.Bool  # whether the path passes a hole
    hit: mi.PreliminaryIntersection3f  # the hit at x1


@dataclass
class Offset:
    """The state of one offset path at the current vertex of its base path."""

    y: mi.SurfaceInteraction3f  # apart: the path's own vertex; joined: the shared vertex, seen from that vertex
    β: mi.Spectrum
    r: mi.Float
    Δ: mi.Spectrum


def base_step(scene, random, x, β, active) -> Step:
    """Samples an emitter and the next vertex from vertex x, where ``active``."""
    # ---------------------- Emitter sampling ----------------------
    u_light = random.next_2d()
    light = sample_light(scene, x, u_light, active)
    L_light = reflected(light, x)

    # ------------------------ BSDF sampling -----------------------
    sample, f_p = x.bsdf().sample(mi.BSDFContext(), x, random.next_1d(), random.next_2d(), active)
    wo, p = sample.wo, consistent(x.bsdf(), x, sample, f_p, active).pdf
    goes_on = active & (p > 0)
    β1 = dr.select(goes_on, β * f_p, 0)
    ray = x.spawn_ray(x.to_world(wo))
    hit = scene.ray_intersect_preliminary(ray, active=goes_on)
    x1 = hit.compute_surface_interaction(ray)
    smooth = ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    hole = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    Le, p_light = emission(scene, x1, x, goes_on, goes_on & smooth)
    L_bsdf = Le * mis_weight(p, p_light)
    return Step(x, β, u_light, light, L_light, wo, p, goes_on, β1, x1, Le, p_light, L_bsdf, smooth, hole, hit)


def reflected(light: LightSample, x) -> mi.Spectrum:
    """f m Le V / p of a sampled emitter at vertex x. m is 1 if BSDF sampling cannot find the emitter."""
    f, p = evaluate(x.bsdf(), x, x.to_local(light.d))
    return f * light.weight * dr.select(light.delta, 1, mis_weight(light.p, p))


def start(scene, active, ray, importance) -> Offset:
    """An offset path up to its first vertex.

    If either path has no first vertex, the shift is rejected. It would also be rejected in the opposite direction, with
    base and offset path exchanged.
    """
    y = scene.ray_intersect(mi.Ray3f(ray))
    lives = active & y.is_valid()
    return Offset(y, β=dr.select(lives, importance, 0), r=dr.select(lives, mi.Float(1), 0), Δ=mi.Spectrum(0))


def step_apart(scene, step: Step, path: Offset) -> Offset:
    """The step from the offset path's own vertex y to the base path's next vertex."""
    x, x1, y = step.x, step.x1, path.y

    # --------------- Emitter sampling: replay ---------------
    # The same random numbers have the same density at x and at y, so r stays 1 (survey, eq. 6).
    light = sample_light(scene, y, step.u_light, path.r > 0)
    Δ = gradient_weight(path.r, True) * (path.β * reflected(light, y) - step.β * step.L_light)

    # -------------- BSDF sampling: reconnection -------------
    # If the base path leaves the scene, its next vertex is at infinity. The same direction leads the offset path to
    # that vertex, with J = 1.
    reaches = x1.is_valid()
    direction = dr.select(reaches, dr.normalize(x1.p - y.p), x.to_world(step.wo))
    shadow = dr.select(reaches, y.spawn_ray_to(x1.p), y.spawn_ray(direction))
    J = dr.select(reaches, reconnection_jacobian(x.p, y.p, x1.p, x1.n), 1)
    f, p = evaluate(y.bsdf(), y, y.to_local(direction))
    r = path.r * J * p / step.p
    # If y cannot see x1, the offset path does not exist. Then no path sampled from its pixel could be shifted back to
    # this base path, so the base path gets the full weight w = 1 (survey, section 3.5).
    good = step.goes_on & (p > 0) & dr.isfinite(r) & ~scene.ray_test(shadow, step.goes_on & (path.r > 0))
    r, β = dr.select(good, r, 0), dr.select(good, path.β * f * (J / step.p), 0)
    y1 = seen_from(x1, direction)
    Le, p_light = emission(scene, y1, y, good, good)
    # For this emission and all later light, base and offset path have the new r, and a new weight (survey, eq. 17).
    Δ += gradient_weight(r, True) * (β * Le * mis_weight(p, p_light) - step.β1 * step.L_bsdf)
    return Offset(y1, β, r, Δ)


def step_joined(step: Step, path: Offset) -> tuple[mi.Spectrum, mi.Spectrum]:
    """The step from the shared vertex, where the offset path arrives from another direction than the base path.

    Returns Δ so far, and the factor ``a`` with which the later radiance R adds to it (Δ + a R).
    """
    y = path.y

    # ---------- Emitter sampling: the same emitter ----------
    w2 = gradient_weight(path.r, True)
    Δ = path.Δ + w2 * (path.β * reflected(step.light, y) - step.β * step.L_light)

    # ---------- BSDF sampling: the same direction -----------
    # Both paths leave the same vertex in the same direction, so J = 1. But the density of that direction depends on the
    # direction from which a path arrives.
    f, p = evaluate(y.bsdf(), y, step.wo)
    good = step.goes_on & (p > 0)
    r, β = dr.select(good, path.r * p / step.p, 0), dr.select(good, path.β * f / step.p, 0)
    w2 = gradient_weight(r, True)
    Δ += w2 * (β * step.Le * mis_weight(p, step.p_light) - step.β1 * step.L_bsdf)
    # All later densities are the same for both paths, so r and w stay the same, and C(y) and C(x) differ only by β.
    return Δ, w2 * (β - step.β1)


def refuse(scene) -> None:
    """Raises NgptError for materials at which paths cannot be reconnected.

    These include rough materials of very low roughness (polish), which the registry's rules for refusing scenes do not
    check.
    """
    if materials := Materials(scene, CONNECTABLE.default).unconnectable:
        more = f" and {len(materials) - 3} more" if len(materials) > 3 else ""
        reason = f"paths cannot be reconnected at {', '.join(materials[:3])}{more}"
        raise NgptError(f"sampler 'gpt-simple' cannot render this scene: {reason}; use --sampler gpt")
