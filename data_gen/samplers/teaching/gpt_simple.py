r"""The gradient-domain path tracer to be read: ``gpt`` where every shift is a reconnection.

It renders scenes whose materials all scatter widely. There an offset path always goes straight from its own first
vertex to the second vertex of its base path, so that the first two steps can be written down one after the other. What
``gpt`` does beyond that (replay, half-vectors, ghosts, shared emitters, kernels cut to a scene) is left out. Functions
and symbols (x, y, L, Le, β, J, p, r, w, m, Δ, a) are as in ``data_gen.samplers.gpt.integrator``, to be read side by
side. R is the radiance that reaches a settled path, and r is 0 once a path is rejected.

An offset path is *apart* from its base path at the first vertex, *joined* to it at the second (it shares the vertex,
but arrives there from elsewhere), and *settled* from the third on, where both are one path. A rejected one needs no
code of its own: with β' = 0 and r = 0, the formulas give w = 1 and Δ = -2 C(x) / p(x), as they should.

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
    (5, and from the third vertex on at the earliest).

    Not handled: mirrors, glass, polish and holes, media, hidden emitters and polarised variants. Media are not seen;
    for the others rendering raises NgptError.
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
    """L, Le and the four Δ, in the order of SHIFTS, of base paths that begin with ``ray``."""
    # ------------------ First vertex: offset paths are apart ------------------
    x = scene.ray_intersect(mi.Ray3f(ray))
    Le = importance * x.emitter(scene).eval(x, limits.max_depth > 0)
    active = x.is_valid() & (limits.max_depth > 1)
    offsets = [start(scene, active, *ray_and_importance) for *ray_and_importance, _ in shifted]
    step = base_step(scene, random, x, importance, active)
    L = step.β * step.L_light + step.β1 * step.L_bsdf
    offsets = [step_apart(scene, step, y) for y in offsets]

    # ------------------ Second vertex: they are joined to it ------------------
    step = base_step(scene, random, step.x1, step.β1, step.x1.is_valid() & (limits.max_depth > 2))
    L += step.β * step.L_light + step.β1 * step.L_bsdf
    settled = [step_joined(step, y) for y in offsets]

    # --------------- From the third on: one path, so one radiance -------------
    R = walk(scene, limits, random, step.x1)
    return L + step.β1 * R, Le, [Δ + a * R for Δ, a in settled]


@dr.syntax
def walk(scene, limits: Limits, random, x):
    """R, the radiance that reaches the second vertex from the third, ``x``."""
    R, β, depth = mi.Spectrum(0), mi.Spectrum(1), mi.UInt32(3)
    active = x.is_valid() & (depth < limits.max_depth)
    while dr.hint(active, label="gpt_simple"):
        step = base_step(scene, random, x, β, active)
        R += β * step.L_light + step.β1 * step.L_bsdf
        # Roulette by the throughput since the second vertex, which all five paths share: none is starved.
        q = roulette(dr.max(step.β1), depth >= limits.rr_depth)
        survives = random.next_1d() < q
        x, β = step.x1, step.β1 / q
        depth += 1
        active = survives & x.is_valid() & (depth < limits.max_depth)
    return R


@dataclass
class Step:
    """What the base path does at its current vertex x; x1 is the next one."""

    x: mi.SurfaceInteraction3f
    β: mi.Spectrum
    # Emitter sampling
    u_light: mi.Point2f
    light: LightSample
    L_light: mi.Spectrum  # f m Le V / p
    # BSDF sampling
    wo: mi.Vector3f
    p: mi.Float
    goes_on: mi.Bool  # there is a next vertex, or an escape
    β1: mi.Spectrum  # β f / p
    x1: mi.SurfaceInteraction3f
    Le: mi.Spectrum  # emitted at x1 toward x
    p_light: mi.Float  # density with which emitter sampling would have found x1
    L_bsdf: mi.Spectrum  # m Le
    smooth: mi.Bool  # no mirror, no hole
    hole: mi.Bool  # the path goes on as if nothing were there
    hit: mi.PreliminaryIntersection3f  # x1 before all of it is known


@dataclass
class Offset:
    """The state of one offset path at the current vertex of its base path."""

    y: mi.SurfaceInteraction3f  # apart: its own vertex; joined: the shared one, reached from its own
    β: mi.Spectrum
    r: mi.Float
    Δ: mi.Spectrum


def base_step(scene, random, x, β, active) -> Step:
    """Samples an emitter and the next vertex from vertex x; nothing where not ``active``."""
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
    """f m Le V / p of a sampled emitter at vertex x: m is 1 where BSDF sampling cannot find it."""
    f, p = evaluate(x.bsdf(), x, x.to_local(light.d))
    return f * light.weight * dr.select(light.delta, 1, mis_weight(light.p, p))


def start(scene, active, ray, importance) -> Offset:
    """An offset path up to its first vertex; rejected where either path has none, as it is from the other side."""
    y = scene.ray_intersect(mi.Ray3f(ray))
    lives = active & y.is_valid()
    return Offset(y, β=dr.select(lives, importance, 0), r=dr.select(lives, mi.Float(1), 0), Δ=mi.Spectrum(0))


def step_apart(scene, step: Step, path: Offset) -> Offset:
    """A step from the offset path's own vertex y, to the base path's next vertex."""
    x, x1, y = step.x, step.x1, path.y

    # --------------- Emitter sampling: replay ---------------
    # The same random numbers have the same density here and there, so r stays 1 (survey, eq. 6).
    light = sample_light(scene, y, step.u_light, path.r > 0)
    Δ = gradient_weight(path.r, True) * (path.β * reflected(light, y) - step.β * step.L_light)

    # -------------- BSDF sampling: reconnection -------------
    # An escape counts as a vertex at infinity: the same direction leads there, with J = 1.
    reaches = x1.is_valid()
    direction = dr.select(reaches, dr.normalize(x1.p - y.p), x.to_world(step.wo))
    shadow = dr.select(reaches, y.spawn_ray_to(x1.p), y.spawn_ray(direction))
    J = dr.select(reaches, reconnection_jacobian(x.p, y.p, x1.p, x1.n), 1)
    f, p = evaluate(y.bsdf(), y, y.to_local(direction))
    r = path.r * J * p / step.p
    # Where y cannot see x1 no path is sampled that way, none is shifted back, and w is 1 (survey, section 3.5).
    good = step.goes_on & (p > 0) & dr.isfinite(r) & ~scene.ray_test(shadow, step.goes_on & (path.r > 0))
    r, β = dr.select(good, r, 0), dr.select(good, path.β * f * (J / step.p), 0)
    y1 = seen_from(x1, direction)
    Le, p_light = emission(scene, y1, y, good, good)
    # From here on the pair has another r, and another weight (survey, eq. 17).
    Δ += gradient_weight(r, True) * (β * Le * mis_weight(p, p_light) - step.β1 * step.L_bsdf)
    return Offset(y1, β, r, Δ)


def step_joined(step: Step, path: Offset) -> tuple[mi.Spectrum, mi.Spectrum]:
    """A step from the shared vertex, to which the offset path has come from elsewhere: Δ so far, and a."""
    y = path.y

    # ---------- Emitter sampling: the same emitter ----------
    w2 = gradient_weight(path.r, True)
    Δ = path.Δ + w2 * (path.β * reflected(step.light, y) - step.β * step.L_light)

    # ---------- BSDF sampling: the same direction -----------
    # Vertex and direction are the same, so J = 1; but the density of that direction is another for another arrival.
    f, p = evaluate(y.bsdf(), y, step.wo)
    good = step.goes_on & (p > 0)
    r, β = dr.select(good, path.r * p / step.p, 0), dr.select(good, path.β * f / step.p, 0)
    w2 = gradient_weight(r, True)
    Δ += w2 * (β * step.Le * mis_weight(p, step.p_light) - step.β1 * step.L_bsdf)
    # All densities from here on are the same for both paths: r and w stay, and of C(y) - C(x) all but β is common.
    return Δ, w2 * (β - step.β1)


def refuse(scene) -> None:
    """Raises NgptError for materials that paths cannot be reconnected at; also for polish, which no description
    shows."""
    if materials := Materials(scene, CONNECTABLE.default).unconnectable:
        more = f" and {len(materials) - 3} more" if len(materials) > 3 else ""
        reason = f"paths cannot be reconnected at {', '.join(materials[:3])}{more}"
        raise NgptError(f"sampler 'gpt-simple' cannot render this scene: {reason}; use --sampler gpt")
