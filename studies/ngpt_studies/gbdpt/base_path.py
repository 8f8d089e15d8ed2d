"""The camera path of ``gbdpt``, vertex by vertex: as in ``bdpt``, with the data that offset paths need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.holes import Edge
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt import plan as both_ends
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import emission_at, to_light
from data_gen.samplers.bdpt.vertex import RADIANCE, Vertex, context, cosine, reverse_density, scatters_smoothly
from ngpt_studies.gbdpt.manifold import event
from ngpt_studies.gbdpt.pairs import difference


@dataclass(kw_only=True)
class Plan(both_ends.Plan):
    """``bdpt``'s plan, and the weight of a path and its copy."""

    pair: Callable = difference  # Δ of a path and its copy, with one of the weights of ``pairs``

    def sees_alike(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, like: tuple[Any, Any], apart: mi.Bool) -> Any:
        """T from the ``target`` to a copy's vertex ``si``; ``like`` is T and the number of holes of the base path.

        Copies that are not ``apart`` have the same T. The others must see the target through the same number of holes.
        So all strategies reject the same copies, and a copy is as long as its path.
        """
        T, holes = self.sees(si, target, like[1], apart)
        return T if self.holes is None else dr.select(apart, dr.select(holes == like[1], T, 0), like[0])

    def outside(self, p: mi.Point3f, d: mi.Vector3f) -> mi.Point3f:
        """A point on the ray from ``p`` along ``d``, outside the scene."""
        return p + d * (4 * self.lights.radius)


@dataclass
class Way:
    """The way of a base path from its last vertex that was not a hole."""

    o: mi.Point3f  # that vertex
    p: mi.Float  # density of the direction there
    weight: mi.Float  # 1 / probability to survive Russian roulette and to pass the holes on the way
    η: mi.Float  # of ``mis`` at that vertex
    holes: mi.UInt32  # the number of holes on the way

    def behind(self, passed: mi.Bool, new: Way) -> Way:
        """The ``new`` way behind an event, or this way if the event ``passed`` a hole, with probability ``new.p``."""
        weight, holes = self.weight * new.weight / new.p, self.holes + 1
        return dr.select(passed, Way(self.o, self.p, weight, self.η, holes), new)


@dataclass
class Past:
    """The history of a base path."""

    η: mi.Float  # product of the relative indices of refraction
    sky: Sky
    way: Way | None = None  # None in scenes without holes

    @classmethod
    def of_camera(cls, plan: Plan) -> Past:
        """At the first vertex that the camera sees."""
        way = Way(mi.Point3f(0), mi.Float(1), mi.Float(1), mi.Float(0), mi.UInt32(0)) if plan.holes else None
        return cls(mi.Float(1), Sky.from_camera(plan.limits.hide_emitters), way)


@dataclass
class Step:
    """A step of the base path from its vertex ``z`` to the next vertex x1."""

    z: Vertex
    connectable: mi.Bool
    # A sampled point of an emitter
    light: mi.DirectionSample3f
    weight: mi.Spectrum  # Le / p
    front: mi.Normal3f | None  # of ``LightEnds.connect()``
    shared: mi.Bool  # whether Δ includes the paths that are completed at z
    C_light: mi.Spectrum
    others_light: mi.Float
    e_light: mi.Float
    f_light: mi.Spectrum
    p_light: mi.Float  # the density of sampling the direction to the light
    q_light: mi.Float
    through: tuple[Any, Any]  # T and the number of holes on the way to the light
    joins_light: mi.Bool  # whether light paths may find the path to that light
    joins: mi.Bool  # whether light paths may be connected at z
    η: mi.Float  # of ``mis`` at z; 0 if no photons are gathered there
    # The sampled direction
    u_lobe: mi.Float
    u_direction: mi.Point2f
    wo: mi.Vector3f
    d: mi.Vector3f
    kind: mi.UInt32
    passed: mi.Bool | bool  # whether it passes a hole, which is no vertex
    event: mi.UInt32  # mirror, glass or hole, of ``manifold``
    p: mi.Float
    q: mi.Float
    f_p: mi.Spectrum  # f / p, divided by the probability to survive
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
    p_met: mi.Float  # the density of connecting to it
    e_met: mi.Float
    counted: mi.Bool  # whether light paths may find paths that end there
    way: Way  # the way that leads there
    edge: Edge | None  # the edge that leads there, for MIS weights; None in scenes without holes


def base_step(
    plan: Plan, random, z: Vertex, past: Past, active, *, brightest_offset: mi.Float, completed: mi.Bool | bool = True
) -> tuple[Step, Past]:
    """Samples an emitter and the next vertex from vertex ``z``. Returns the step, and the ``past`` at the next vertex.

    ``brightest_offset`` is the largest throughput with which an offset path may still contribute, so that Russian
    roulette does not end a path whose copies are brighter. Emitters are sampled only where ``completed`` is true.
    Random numbers are drawn in any case.
    """
    scene, lights, materials = plan.scene, plan.lights, plan.materials
    si, end, bsdf = z.si, z.end, z.si.bsdf()
    smooth = active & completed & scatters_smoothly(bsdf)
    joins = z.depth + 1 <= plan.longest

    # ------------------------ To a light -------------------------
    u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
    u_survival = random.next_1d()
    light, weight, front = lights.connect(scene, si, u_light, smooth)
    lit = smooth & (light.pdf > 0)
    wo = si.to_local(light.d)
    f, p, sample, f_p = bsdf.eval_pdf_sample(context(RADIANCE), si, wo, u_lobe, u_direction)
    f = dr.select(dr.isfinite(dr.sum(f)) & dr.isfinite(p), f, 0)
    lit &= dr.max(f * weight) > 0
    q = reverse_density(si, bsdf, wo, lit)
    through = plan.sees(si, light.p, plan.limits.max_depth - (z.depth + 1), lit)
    joins_light = z.depth + 1 + through[1] <= plan.longest
    known = Vertex(si, z.β, known_end(end, joins_light), z.depth)
    C, others = to_light(lights, known, light, weight, f, p=p, q=q)
    C = dr.select(lit, C * through[0], 0)
    cos = dr.abs(dr.dot(light.n, light.d))
    e = lights.emission(lights.index_of(light.emitter), light.pdf, cos, dr.square(light.dist))

    # ------------------------ Next vertex ------------------------
    found = active & (sample.pdf > 0)
    kind = event_kind(sample.sampled_type)
    sky = past.sky.behind(kind, found)
    η = dr.select(found, past.η * sample.eta, past.η)
    d = si.to_world(sample.wo)
    q_next = reverse_density(si, bsdf, sample.wo, found & (kind == SMOOTH))
    β = z.β * f_p
    survives = roulette(dr.fmax(dr.max(β), brightest_offset), z.depth >= plan.limits.rr_depth, η)
    goes_on = found & (dr.max(β) > 0) & (u_survival < survives)
    survival = dr.rcp(survives)
    x1 = scene.ray_intersect(si.spawn_ray(d), goes_on)

    # ------------------ Emission met by chance -------------------
    met = goes_on & sky.meets(x1)
    # Light paths do not find longer paths.
    counted = z.depth + 1 <= plan.longest
    η_merged = plan.merged(bsdf, joins)
    end1 = mis.leave(end, cosine(si, d), sample.pdf, q_next, kind != SMOOTH, η_merged)
    end1, edge = plan.onward(z, bsdf, sample, end1)
    Le, p_met, e_met = emission_at(scene, lights, x1, si if edge is None else edge.seen_by(si), met)
    way, passed = Way(si.p, sample.pdf, survival, η_merged, mi.UInt32(0)), False
    if edge is not None:
        # No emitter is sampled from the camera itself.
        p_met, e_met = dr.select(edge.first, 0, p_met), dr.select(edge.first, 0, e_met)
        passed = plan.holes.passed(bsdf, kind)
        way = past.way.behind(passed, way)
    step = Step(
        z=z,
        connectable=active & materials.connectable(bsdf),
        light=light,
        weight=weight,
        front=front,
        shared=mi.Bool(True),
        C_light=C,
        others_light=others,
        e_light=e,
        f_light=f,
        p_light=p,
        q_light=q,
        through=through,
        joins_light=joins_light,
        joins=joins,
        η=η_merged,
        u_lobe=u_lobe,
        u_direction=u_direction,
        wo=sample.wo,
        d=d,
        kind=kind,
        passed=passed,
        event=event(sample.sampled_type),
        p=sample.pdf,
        q=q_next,
        f_p=f_p * survival,
        survival=survival,
        goes_on=goes_on,
        β1=β * survival,
        x1=x1,
        end1=plan.arrives(end1, edge, x1, d),
        x1_connectable=materials.connectable(x1.bsdf()),
        met=met,
        C_met=dr.select(met, β * survival * Le, 0),
        others_met=mis.others_emitted(known_met(end1, counted), e_met, p_met),
        Le=Le,
        p_met=p_met,
        e_met=e_met,
        counted=counted,
        way=way,
        edge=edge,
    )
    return step, Past(η, sky, way if plan.holes else None)


def known_end(end: Partial, joins: mi.Bool) -> Partial:
    """The partial sums at a vertex. Paths too long for light paths are weighted as if there were no light paths."""
    return Partial(dr.select(joins, end.vcm, 0), dr.select(joins, end.vc, 0))


def known_met(end: Partial, counted: mi.Bool) -> Partial:
    """As ``known_end()``, for emission that is met by chance. Emitter sampling may find it, whatever the length."""
    return Partial(end.vcm, dr.select(counted, end.vc, 0))
