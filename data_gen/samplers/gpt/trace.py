"""All paths of ``gpt`` from the camera to their ends. Symbols as in ``gpt``."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.samplers.gpt.base_path import Path, base_step, begin
from data_gen.samplers.gpt.offset_path import Offset, next_steps, start
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.gpt.tails import end
from data_gen.tails.cache import Trail


@dataclass
class Traced:
    """What base paths and their offset paths have found so far."""

    L: mi.Spectrum  # radiance of base paths, without the emission that the camera sees directly
    Le: mi.Spectrum  # the emission that the camera sees directly
    L_caustic: mi.Spectrum  # the light of the layer ``caustic``
    shared: mi.Spectrum  # a sample of the error of the light that comes from the cache
    offsets: list[Offset]


def trace(view, plan: Plan, random, camera_ray: tuple, shifted: list, within=None, *, known=None) -> Traced:
    """Traces base paths and their four offset paths. Base paths begin with ``camera_ray``: a ray and its importance.

    Offset paths begin with the ``shifted`` rays, in the order of SHIFTS. The camera is in the medium ``within``.
    ``view`` is the integrator, which knows what is hidden from the camera. Paths may end where the cache has ``known``
    light; None: there is no cache.
    """
    # --------------------- First vertices ------------------------
    (ray, importance), space, scene = camera_ray, plan.space, plan.space.scene
    drawn = space.begin(random)
    first = space.first(view, ray, within, drawn)
    x, β = media.vertex(mi.Ray3f(first.ray), first.hit, first.place), importance * first.weight
    path = begin(plan, x, first.place, drawn.channel if drawn else None, β)
    if known:
        path.trail, path.ρ = Trail.to(space.length(ray.o, x)), mi.Color3f(0)
    # Le is kept out of the gradients: it has little noise, but its edges would be the strongest of the image.
    if space.media:
        Le = importance * view.lamps_in_fog(scene, space.media, ray, within, drawn.channel)
    else:
        Le = importance * x.emitter(scene).eval(x, path.sky.meets(x) & (plan.limits.max_depth > 0))
    L = L_first = β * view.behind_grids(scene, space.media, first) if space.grids else mi.Spectrum(0)
    offsets = []
    for offset_ray, offset_importance, inside in shifted:
        there = space.first(view, offset_ray, within, drawn)
        y = start(plan, path, there, offset_importance, inside)
        if space.grids:
            # Both paths use the same random numbers in this segment, so r = 1 and w = 1/2.
            y.Δ = y.β * view.behind_grids(scene, space.media, there) - L_first
            y.A = dr.select(inside, 1, 2) * L_first
        offsets.append(y)
    L, L_caustic, shared = (light + dr.zeros(mi.Spectrum, dr.width(x.t)) for light in (L, 0, 0))
    so_far = Traced(L, Le, L_caustic, shared, offsets)
    if plan.limits.max_depth < 2:
        return so_far
    # Loop optimisation would record each loop twice, and would not make the kernel quicker.
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        if not plan.replays:
            # Without replay no offset path is apart after the first step. So if the first step is outside the loop, the
            # loop needs no code for paths that are apart.
            path, so_far = go_on(scene, plan, random, path, so_far, known=known, first=True)
        return walk(scene, plan, random, path, so_far, known)


def go_on(scene, plan: Plan, random, path: Path, so_far: Traced, *, known, first=False) -> tuple[Path, Traced]:
    # The base path goes first, because an offset path can only join a vertex that is already known.
    step, path = base_step(scene, plan, random, path, so_far.offsets)
    # Emitter sampling and BSDF sampling each give a term. The two terms are weighted against each other by m, and are
    # shifted separately.
    L, L_caustic = so_far.L + (step.β * step.L_light + step.β1 * step.L_bsdf), so_far.L_caustic
    if plan.caustic:
        L_caustic = L_caustic + step.β * step.L_caustic
    offsets = next_steps(scene, plan, step, so_far.offsets, first)
    shared = so_far.shared
    if known:
        path, tail, caustic_tail, error = end(plan, known, path, offsets)
        L, L_caustic, shared = L + tail, L_caustic + caustic_tail, shared + error
    return path, Traced(L, so_far.Le, L_caustic, shared, offsets)


@dr.syntax
def walk(scene, plan: Plan, random, path: Path, so_far: Traced, known) -> Traced:
    active = path.goes_on(plan, so_far.offsets)
    while dr.hint(active, label="gpt", exclude=[known]):
        path, so_far = go_on(scene, plan, random, path, so_far, known=known)
        active = path.goes_on(plan, so_far.offsets)
    return so_far
