r"""Carries records into the scene of another frame, and recomputes them if shapes or lights have moved.

A path is the same in both scenes if it has the same random numbers, and rc is the same point of the same shape:

| part of the path | in the other scene | Jacobian |
|---|---|---|
| prefix, choice of an emitter | the same random numbers, replayed by ``evaluate``, as from pixel to pixel | 1 |
| rc | the point moves with its shape | the stretch of the surface there, as a factor of ``geometry`` |
| the direction from rc | the same in world space | 1 |
| the path behind it | the same random numbers; light and Russian roulette are computed again | 1 |

None of this depends on the pixel of the path. So a record is carried once, and all other steps evaluate E in one of the
scenes. The way back follows the same rules. Records that it could not carry back are not carried: rc on a shape that
does not exist in both scenes, or whose triangles differ. [Lin et al. 2022: shifts between domains of any kind, here
between two times]
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission
from data_gen.paths.mis import mis_weight
from data_gen.paths.vertex import SMOOTH, evaluate
from data_gen.paths.walk import roulette
from data_gen.samplers.gpt.base_path import light_mis
from data_gen.samplers.gpt.plan import Plan
from data_gen.scenes.geometry import Triangles
from ngpt_studies.restir.record import LIGHT, RC_LIGHT, REPLAY, STUCK, SUFFIX, Record, word_of
from ngpt_studies.restir.stage import Stage
from ngpt_studies.restir.walk import DRAWN, draw, sample_event


class Carry:
    """Carries records from ``source`` to ``target``. It stores how each shape moves between the scenes."""

    def __init__(self, source: Stage, target: Stage):
        self.target = target
        ids = np.array(dr.reinterpret_array(mi.UInt32, source.scene.shapes_dr()))
        number = np.full(int(ids.max(initial=0)) + 1, -1, np.int32)
        number[ids] = np.arange(len(ids))
        count = min(len(source.shapes), len(target.shapes))
        number[number >= count] = -1
        moves, first, stretches = np.tile(np.eye(4)[:3], (max(count, 1), 1, 1)), np.zeros(max(count, 1), np.uint32), []
        last, unit = 1, np.ones(1)
        for i in range(count):
            old, new = source.shapes[i], target.shapes[i]
            if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
                if not np.array_equal(old, new):
                    moves[i] = (new @ np.linalg.inv(old))[:3]
            elif isinstance(old, Triangles) and isinstance(new, Triangles) and old.faces.shape == new.faces.shape:
                if not (np.array_equal(old.vertices, new.vertices) and np.array_equal(old.faces, new.faces)):
                    first[i] = last
                    stretches.append(_areas(new) / np.maximum(_areas(old), 1e-37))
                    last += len(new.faces)
            else:
                number[number == i] = -1
        self.number = mi.Int32(number)
        self.size = dr.opaque(mi.UInt32, len(number))
        self.shapes = target.scene.shapes_dr()
        self.moves = [[mi.Float(np.ascontiguousarray(moves[:, i, j])) for j in range(4)] for i in range(3)]
        self.first = mi.UInt32(first)
        self.stretches = mi.Float(np.concatenate([unit, *stretches]).astype(np.float32))
        self.stretched = mi.Bool(first > 0)

    def __call__(self, seed: int, record: Record, active: mi.Bool) -> Record:
        """Returns the records in the target scene, evaluated. Records that are not ``active`` have undefined values."""
        target = self.target
        kind, far = record.kind, record.escapes()
        joined = active & (kind != LIGHT) & (kind != REPLAY) & (kind != STUCK)
        surface = joined & ~far
        pointer = dr.reinterpret_array(mi.UInt32, record.shape)
        at = dr.gather(mi.Int32, self.number, pointer, surface & (pointer < self.size))
        known = surface & (pointer < self.size) & (at >= 0)
        at = dr.select(known, mi.UInt32(at), 0)
        shape = dr.gather(mi.ShapePtr, self.shapes, at, known)

        # rc: on a mesh it moves with its triangle, on other shapes with their motion
        rows = [[dr.gather(mi.Float, value, at) for value in row] for row in self.moves]
        A = mi.Matrix3f([row[:3] for row in rows])
        P = mi.Point3f(A @ mi.Vector3f(record.P) + mi.Vector3f(*(row[3] for row in rows)))
        moved = replace(record, P=P, shape=shape)
        # Any viewpoint will do. This one is about as far away as the previous vertex, so rounding errors are similar.
        hit, ray = moved.hit(P + record.w * dr.rsqrt(dr.maximum(record.geometry, 1e-20)))
        x = hit.compute_surface_interaction(ray, active=known)
        face = dr.gather(mi.Bool, self.stretched, at)
        place = dr.gather(mi.UInt32, self.first, at) + dr.select(face, record.primitive, 0)
        stretch = dr.gather(mi.Float, self.stretches, place)
        # A plane that A moves has its normal multiplied by the inverse transpose of A.
        n = mi.Vector3f(x.n)
        stretch *= dr.abs(dr.det(A)) / dr.norm(
            sum((mi.Vector3f(*rows[i][:3]) * n[i] for i in range(3)), mi.Vector3f(0))
        )
        lost = surface & ~(known & x.is_valid() & (stretch > 0) & dr.isfinite(stretch))

        behind = known & ~lost & ((kind == RC_LIGHT) | (kind == SUFFIX))
        camera = CameraSamples.replayed(target.sensor, seed, record.pixel, record.sample, record.place)
        # The random numbers of rc come after those of the replayed vertices and of the vertex before rc.
        random = camera.random
        random.skip(mi.UInt32(DRAWN) * (record.replayed + 1))
        w, L, p_light, delta = _behind(target.scene, target.plan, random, x, record, behind)
        at_rc = behind & record.sampled & (record.behind == 0)
        kind = dr.select(at_rc, dr.select(delta, mi.UInt32(SUFFIX), mi.UInt32(RC_LIGHT)), kind)
        kind = dr.select(lost, mi.UInt32(STUCK), kind)
        found = replace(
            moved,
            word=word_of(kind, record.replayed, record.behind, record.sampled),
            P=dr.select(known, x.p, record.P),
            w=dr.select(behind, w, record.w),
            L=dr.select(behind, L, record.L),
            p_light=dr.select(behind, p_light, record.p_light),
            geometry=dr.select(known, record.geometry / stretch, record.geometry),
        )
        dr.eval(found)
        return found


def _areas(mesh: Triangles) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _behind(
    scene: mi.Scene, plan: Plan, random, x: mi.SurfaceInteraction3f, record: Record, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float, mi.Bool]:
    """Recomputes ``w``, ``L`` and ``p_light`` of a record behind rc, ``x``; and whether the lamp sampled at rc is a
    Dirac delta."""
    light, Le_p, lit = _sampled(scene, plan, x, draw(random), active & record.sampled & (record.behind == 0))
    w = dr.select(lit, light.d, record.w)
    L = dr.select(lit, Le_p, 0)
    p_light = dr.select(lit & ~light.delta, light.pdf, 0)

    walks = active & (record.behind > 0)
    x1 = scene.ray_intersect(x.spawn_ray(record.w), walks)
    met = walks & (record.behind == 1) & ~record.sampled
    Le, p = emission(scene, x1, x, met, met, plan.lights)
    L = dr.select(met, Le, L)
    p_light = dr.select(met, p, p_light)
    return w, L + _further(scene, plan, random, x1, record, walks & ~met & x1.is_valid()), p_light, light.delta


def _sampled(scene: mi.Scene, plan: Plan, x: mi.SurfaceInteraction3f, numbers, active: mi.Bool):
    """An emitter sampled at ``x``, its Le V / p, and whether there is one."""
    lit = active & mi.has_flag(x.bsdf().flags(), mi.BSDFFlags.Smooth)
    light, Le_p = plan.lights.seen(scene, x, numbers.light, lit)
    return light, Le_p, lit & (light.pdf != 0)


@dr.syntax
def _further(scene, plan: Plan, random, x, record: Record, active):
    """``L`` of paths that go on behind ``x``, the first vertex after rc: as in ``walk``, for a single path."""
    L = mi.Spectrum(0)  # light of the path's lamp
    B = mi.Spectrum(1)  # f / p of all vertices since rc, with Russian roulette
    η = mi.Float(1)  # product of the relative indices of refraction since rc
    i = mi.UInt32(1)  # vertices behind rc so far
    depth = record.replayed + 3  # number of x in the whole path
    behind, sampled = record.behind, record.sampled
    while active:
        numbers = draw(random)
        light, Le_p, lit = _sampled(scene, plan, x, numbers, active & sampled & (i == behind))
        f, p = evaluate(x.bsdf(), x, x.to_local(light.d), lit)
        L = dr.select(lit, B * f * light_mis(light.delta, light.pdf, p) * Le_p, L)
        event = sample_event(scene, plan, x, numbers, active & (i < behind))
        η = dr.select(event.found, η * event.η, η)
        B *= event.f_p
        q = roulette(dr.max(B), depth >= plan.limits.rr_depth, η)
        walks = event.found & (dr.max(B) > 0) & (numbers.survival < q)
        B = dr.select(walks, B * dr.rcp(q), 0)
        met = walks & ~sampled & (i + 1 == behind)
        Le, p_light = emission(scene, event.x1, x, met, met & (event.kind == SMOOTH), plan.lights)
        L = dr.select(met, B * Le * mis_weight(event.p, p_light), L)
        x = event.x1
        i += 1
        depth += 1
        active = walks & ~met & x.is_valid() & (i <= behind)
    return L
