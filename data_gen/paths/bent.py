"""Sampling of "bent" lamps with the right density. These are mesh lamps whose vertex normals differ from their face
normals.

Mitsuba uses the vertex normals to convert the density of a point on a mesh into a density of directions, both when it
samples the point and when it evaluates the density (its issue 1952). But the solid angle of a face depends on the
normal of the face. Here such lamps are sampled by their face normals. As in Mitsuba, they shine in front of their
vertex normals. A point is not sampled from places that are in front of only one of its two normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.scenes.lamps import Chosen, emitter_numbers
from data_gen.scenes.lost import is_bent


@dataclass
class Point:
    """A point on a lamp: its place, the face normal ``n``, the interpolated vertex normal ``front``, and its uv."""

    p: mi.Point3f
    n: mi.Normal3f
    front: mi.Normal3f
    uv: mi.Point2f


class BentLamps:
    """The bent lamps of a scene, by the numbers of its emitters."""

    @staticmethod
    def of(scene: mi.Scene) -> BentLamps | None:
        """The bent lamps of ``scene``, or None if it has none."""
        # Shapes that are found by their emitters are not always known to be meshes.
        found = [shape for shape in scene.shapes() if shape.is_emitter() and is_bent(shape)]
        numbers = {emitter.ptr: number for number, emitter in enumerate(scene.emitters())} if found else {}
        bent = {numbers[shape.emitter().ptr]: shape for shape in found}
        return BentLamps(scene, bent) if bent else None

    def __init__(self, scene: mi.Scene, bent: dict[int, mi.Mesh]):
        count = len(scene.emitters())
        faces = {number: _Faces(mesh) for number, mesh in bent.items()}
        first = np.cumsum([0, *(len(each.upto) for each in faces.values())])
        # Rows: first face, number of faces (0 for an emitter that is not bent), 1 / area, and the side (-1: flipped
        # normals)
        table = np.zeros((4, count + 1))
        rows = [(1 / each.area, each.side) for each in faces.values()]
        table[:, list(bent)] = [first[:-1], np.diff(first), *zip(*rows, strict=True)]
        self.most = max(len(each.upto) for each in faces.values())
        self.emitters, self.indices = scene.emitters_dr(), emitter_numbers(scene, none=count)
        self.first, self.faces = (mi.UInt32(row.astype(np.uint32)) for row in table[:2])
        self.per_area, self.side = (mi.Float(row.astype(np.float32)) for row in table[2:])
        self.upto, self.corners, self.fronts, self.uvs = (
            mi.Float(np.concatenate([getattr(each, name).ravel() for each in faces.values()]).astype(np.float32))
            for name in ("upto", "corners", "fronts", "uvs")
        )

    def has(self, lamp: mi.UInt32, active: mi.Bool = True) -> mi.Bool:
        return dr.gather(mi.UInt32, self.faces, lamp, active) > 0

    def number(self, emitter: mi.EmitterPtr, active: mi.Bool = True) -> mi.UInt32:
        """The number of an emitter in the scene, or the number of emitters if ``emitter`` is none."""
        return dr.gather(mi.UInt32, self.indices, dr.reinterpret_array(mi.UInt32, emitter), active)

    def point(self, lamp: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> Point:
        """A point on the bent lamp with number ``lamp``, distributed uniformly by area."""
        first, count = (dr.gather(mi.UInt32, table, lamp, active) for table in (self.first, self.faces))
        last = dr.select(count > 0, first + count - 1, first)

        def is_before(i: mi.UInt32) -> mi.Bool:
            return dr.gather(mi.Float, self.upto, dr.minimum(first + i, last), active) <= u.x

        face = dr.minimum(first + dr.binary_search(0, self.most - 1, is_before), last)
        before = dr.gather(mi.Float, self.upto, face - 1, active & (face > first))
        share = dr.gather(mi.Float, self.upto, face, active) - before
        left = dr.clip((u.x - before) / dr.maximum(share, 1e-20), 0, dr.one_minus_epsilon(mi.Float))
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(left, u.y))

        def corners(kind: type, values: mi.Float) -> list:
            return [dr.gather(kind, values, 3 * face + corner, active) for corner in range(3)]

        def mixed(parts: list):
            return parts[0] * (1 - b.x - b.y) + parts[1] * b.x + parts[2] * b.y

        p = corners(mi.Point3f, self.corners)
        side = dr.gather(mi.Float, self.side, lamp, active)
        n = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0])) * side
        front = dr.normalize(mixed(corners(mi.Normal3f, self.fronts)))
        return Point(mi.Point3f(mixed(p)), mi.Normal3f(n), mi.Normal3f(front), mixed(corners(mi.Point2f, self.uvs)))

    def sample(
        self, x: mi.Interaction3f, chosen: Chosen, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.Normal3f]:
        """As ``scene.sample_emitter_direction()``, for the ``chosen`` lamp, bent or not; and ``Point.front``."""
        emitter = dr.gather(mi.EmitterPtr, self.emitters, chosen.lamp, active)
        bent = active & self.has(chosen.lamp, active)
        light, weight = emitter.sample_direction(x, chosen.u, active & ~bent)
        here = self.point(chosen.lamp, chosen.u, bent)
        to = mi.Vector3f(here.p - x.p)
        dist = dr.norm(to)
        d = to / dist
        p = self.density(chosen.lamp, here.n, d, dist)
        Le = self.emitted(emitter, here, -d, x, bent)
        p = dr.select(dr.dot(here.front, d) < 0, p, 0)
        ours = {"p": here.p, "n": here.n, "uv": here.uv, "pdf": p, "d": d, "dist": dist}
        for name, value in ours.items():
            setattr(light, name, dr.select(bent, value, getattr(light, name)))
        light.delta &= ~bent
        light.emitter = emitter
        weight = dr.select(bent, dr.select(p > 0, Le / p, mi.Spectrum(0)), weight)
        light.pdf *= chosen.p
        return light, weight / chosen.p, here.front

    def density(self, lamp: mi.UInt32, n: mi.Normal3f, d: mi.Vector3f, dist: mi.Float) -> mi.Float:
        """The density per solid angle of sampling a bent lamp in direction ``d``, at a point with face normal ``n``."""
        cos = -dr.dot(n, d)
        return dr.select(cos > 0, dr.gather(mi.Float, self.per_area, lamp) * dr.square(dist) / cos, 0)

    def corrected(self, p: mi.Float, light: mi.DirectionSample3f, si: mi.SurfaceInteraction3f, choice, active):
        """The density of sampling the emitter that was met at ``si``, and the normal there, also right for bent lamps.

        ``p`` is Mitsuba's density. ``choice`` (lamp, active) returns the probability of choosing a lamp.
        """
        lamp = self.number(light.emitter, active)
        bent = active & self.has(lamp, active)
        ours = choice(lamp, bent) * self.density(lamp, si.n, light.d, light.dist)
        return dr.select(bent, ours, p), mi.Normal3f(dr.select(bent, si.n, light.n))

    def emitted(self, emitter: mi.EmitterPtr, here: Point, w: mi.Vector3f, at, active: mi.Bool) -> mi.Spectrum:
        """Le from a point in direction ``w``, at the time and wavelengths of ``at``."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(here.p))
        si.p, si.n, si.uv, si.sh_frame = here.p, here.n, here.uv, mi.Frame3f(here.front)
        si.wi, si.time, si.wavelengths = si.to_local(w), at.time, at.wavelengths
        return emitter.eval(si, active)


def sample_emitter(scene: mi.Scene, bent: BentLamps | None, x: mi.Interaction3f, u: mi.Point2f, active) -> tuple:
    """``scene.sample_emitter_direction(x, u, False, active)``, also right for ``bent`` lamps. The third value is
    ``Point.front``, or None in scenes without bent lamps."""
    if not bent:
        return *scene.sample_emitter_direction(x, u, False, active), None
    return bent.sample(x, Chosen.of_scene(scene, u, active), active)


class _Faces:
    """The triangles of a mesh: ``corners``, vertex normals (``fronts``) and ``uvs``, each (F, 3, ...); the total
    ``area``; ``upto`` (F), each face's cumulative share of the area; ``side``, -1 if normals are flipped, else 1."""

    def __init__(self, mesh: mi.Mesh):
        params = mi.traverse(mesh)
        faces = np.array(params["faces"]).reshape(-1, 3)
        self.corners = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)[faces]
        self.side = -1.0 if mesh.has_flipped_normals() else 1.0
        self.fronts = self.side * np.array(params["vertex_normals"], np.float64).reshape(-1, 3)[faces]
        if mesh.has_vertex_texcoords():
            self.uvs = np.array(params["vertex_texcoords"], np.float64).reshape(-1, 2)[faces]
        else:
            self.uvs = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (len(faces), 1, 1))
        across = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        areas = np.linalg.norm(across, axis=-1) / 2
        self.area = areas.sum()
        self.upto = np.cumsum(areas) / self.area
        # Above any random number, even if the sum was rounded down
        self.upto[-1] = 1
