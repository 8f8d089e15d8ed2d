"""The camera path of ``gbdpt``, vertex by vertex: that of ``bdpt``, and what offset paths need to know of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.light_ends import LightEnds
from data_gen.paths.manifold import event
from data_gen.paths.vertex import NULL, SMOOTH, Materials, event_kind
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import emission_at, to_light
from data_gen.samplers.bdpt.vertex import RADIANCE, Vertex, context, cosine, reverse_density, scatters_smoothly
from data_gen.samplers.gbdpt.pairs import difference


@dataclass
class Plan:
    """What does not change while a scene is rendered."""

    lights: LightEnds
    materials: Materials
    max_depth: int
    rr_depth: int
    longest: int  # the number of edges up to which paths are found from both ends
    pair: Callable = difference  # Δ of a path and its copy, by one of the weights of ``pairs``
    η: mi.Float | None = None  # of ``mis``, where photons are gathered, too

    @property
    def joins(self) -> bool:
        """Whether there are paths from lights."""
        return self.longest > 1 and self.lights.emitters is not None

    def merged(self, bsdf: mi.BSDFPtr, joins: mi.Bool | bool = True) -> mi.Float:
        """η at a vertex of that material; 0 where nothing merges."""
        if self.η is None:
            return mi.Float(0)
        return dr.select(self.materials.connectable(bsdf) & joins, self.η, 0)

    def known(self, end: Partial, bsdf: mi.BSDFPtr) -> Partial:
        """What a light path knows at a vertex of that material."""
        return end if self.η is None else mis.gathered(end, self.merged(bsdf))


@dataclass
class Step:
    """What the base path does at its vertex ``z``; x1 is the next one."""

    z: Vertex
    connectable: mi.Bool
    # A sampled point of an emitter
    light: mi.DirectionSample3f
    weight: mi.Spectrum  # Le / p
    shared: mi.Bool  # Δ has a share in what is completed at z
    C_light: mi.Spectrum
    others_light: mi.Float
    e_light: mi.Float
    f_light: mi.Spectrum
    p_light: mi.Float  # of sampling that direction
    q_light: mi.Float
    joins: mi.Bool  # light paths may find paths that end here
    η: mi.Float  # photons that are gathered here; 0 if none are
    # The sampled direction
    u_lobe: mi.Float
    u_direction: mi.Point2f
    wo: mi.Vector3f
    d: mi.Vector3f
    kind: mi.UInt32
    event: mi.UInt32  # mirror, glass or hole, of ``manifold``
    p: mi.Float
    q: mi.Float
    f_p: mi.Spectrum  # f / p, survival included
    survival: mi.Float  # 1 / probability
    goes_on: mi.Bool
    β1: mi.Spectrum
    end1: Partial
    # The next vertex, and emission there
    x1: mi.SurfaceInteraction3f
    x1_connectable: mi.Bool
    met: mi.Bool
    C_met: mi.Spectrum
    others_met: mi.Float
    Le: mi.Spectrum
    p_met: mi.Float  # of connecting to it
    e_met: mi.Float
    counted: mi.Bool  # light paths may find paths that end there


def base_step(
    scene,
    plan: Plan,
    random,
    z: Vertex,
    active,
    η: mi.Float,
    sky_seen: mi.Bool,
    brightest_offset: mi.Float,
    completed: mi.Bool | bool = True,
) -> tuple[Step, mi.Float, mi.Bool]:
    """Samples an emitter and the next vertex from vertex ``z``; returns the step, and the next ``η`` and ``sky_seen``.

    ``η`` is the product of all indices of refraction, ``sky_seen`` whether an escape sees the environment, and
    ``brightest_offset`` the most that any offset path may yet bring: Russian roulette is to starve none. Light is asked
    for where paths are ``completed`` at z; random numbers are drawn all the same.
    """
    lights, materials = plan.lights, plan.materials
    si, end, bsdf = z.si, z.end, z.si.bsdf()
    smooth = active & completed & scatters_smoothly(bsdf)
    joins = z.depth + 1 <= plan.longest

    # ------------------------ To a light -------------------------
    u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
    u_survival = random.next_1d()
    light, weight = scene.sample_emitter_direction(si, u_light, False, smooth)
    lit = smooth & (light.pdf > 0)
    wo = si.to_local(light.d)
    f, p, sample, f_p = bsdf.eval_pdf_sample(context(RADIANCE), si, wo, u_lobe, u_direction)
    f = dr.select(dr.isfinite(dr.sum(f)) & dr.isfinite(p), f, 0)
    lit &= dr.max(f * weight) > 0
    q = reverse_density(si, bsdf, wo, lit)
    known = Vertex(si, z.β, known_end(end, joins), z.depth)
    C, others = to_light(lights, known, light, weight, f, p, q)
    C = dr.select(lit & ~scene.ray_test(si.spawn_ray_to(light.p), lit), C, 0)
    cos = dr.abs(dr.dot(light.n, light.d))
    e = lights.emission(lights.index_of(light.emitter), light.pdf, cos, dr.square(light.dist))

    # ------------------------ Next vertex ------------------------
    found = active & (sample.pdf > 0)
    kind = event_kind(sample.sampled_type)
    sky_seen = sky_seen | (found & (kind != NULL))
    η = dr.select(found, η * sample.eta, η)
    d = si.to_world(sample.wo)
    q_next = reverse_density(si, bsdf, sample.wo, found & (kind == SMOOTH))
    β = z.β * f_p
    # As in ``path``: η² undoes what refraction does to radiance, and none survives for ever.
    brightest = dr.fmax(dr.max(β), brightest_offset)
    survives = dr.select(z.depth < plan.rr_depth, 1, dr.fmin(brightest * dr.square(η), 0.95))
    goes_on = found & (dr.max(β) > 0) & (u_survival < survives)
    survival = dr.rcp(survives)
    x1 = scene.ray_intersect(si.spawn_ray(d), goes_on)

    # ------------------ Emission met by chance -------------------
    met = goes_on & (x1.is_valid() | sky_seen)
    Le, p_met, e_met = emission_at(scene, lights, x1, si, met)
    # Longer paths are not found by light paths.
    counted = z.depth + 1 <= plan.longest
    η_merged = plan.merged(bsdf, joins)
    end1 = mis.leave(end, cosine(si, d), sample.pdf, q_next, kind != SMOOTH, η_merged)
    step = Step(
        z=z,
        connectable=active & materials.connectable(bsdf),
        light=light,
        weight=weight,
        shared=mi.Bool(True),
        C_light=C,
        others_light=others,
        e_light=e,
        f_light=f,
        p_light=p,
        q_light=q,
        joins=joins,
        η=η_merged,
        u_lobe=u_lobe,
        u_direction=u_direction,
        wo=sample.wo,
        d=d,
        kind=kind,
        event=event(sample.sampled_type),
        p=sample.pdf,
        q=q_next,
        f_p=f_p * survival,
        survival=survival,
        goes_on=goes_on,
        β1=β * survival,
        x1=x1,
        end1=mis.arrive(end1, cosine(x1, d), dr.square(x1.t)),
        x1_connectable=materials.connectable(x1.bsdf()),
        met=met,
        C_met=dr.select(met, β * survival * Le, 0),
        others_met=mis.others_emitted(known_met(end1, counted), e_met, p_met),
        Le=Le,
        p_met=p_met,
        e_met=e_met,
        counted=counted,
    )
    return step, η, sky_seen


def known_end(end: Partial, joins: mi.Bool) -> Partial:
    """At a vertex: paths longer than light paths are weighted as if light paths found none."""
    return Partial(dr.select(joins, end.vcm, 0), dr.select(joins, end.vc, 0))


def known_met(end: Partial, counted: mi.Bool) -> Partial:
    """The same on the way to emission that is met by chance, which a sampled emitter finds all the same."""
    return Partial(end.vcm, dr.select(counted, end.vc, 0))
