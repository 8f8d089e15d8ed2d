"""An emitter that stands for many lamps in one mesh. ``many_lamps`` makes these meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass
class LampFaces:
    """The lamps of one mesh: the ``corners`` (F, 3, 3) of all faces, the number of each face's ``lamp`` (F,), and the
    ``radiance`` (L, 3) of each lamp."""

    corners: np.ndarray
    lamp: np.ndarray
    radiance: np.ndarray

    @property
    def smallest(self) -> float:
        """The smallest diagonal of the lamps' bounding boxes."""
        each = (self.corners[self.lamp == i] for i in range(len(self.radiance)))
        return min(float(np.linalg.norm(np.ptp(corners, axis=(0, 1)))) for corners in each)


def lamps(table: LampFaces) -> mi.Emitter:
    """The emitter of these lamps, in the current variant of Mitsuba."""
    return _emitter(mi.variant())(table)


def table_of(emitter: mi.Emitter) -> LampFaces | None:
    """The table of an emitter with many lamps; None for any other emitter."""
    table = getattr(emitter, "table", None)
    return table if isinstance(table, LampFaces) else None


def is_area(emitter: mi.Emitter) -> bool:
    """Whether an emitter is a surface that shines to its front. The emitter may stand for one lamp or for many."""
    return table_of(emitter) is not None or emitter.class_name() == "AreaLight"


def mesh_of(props: mi.Properties) -> mi.Mesh:
    """The mesh of the lamps in ``props["emitter"]``. No two of its faces share a vertex."""
    table = props["emitter"].table
    count = 3 * len(table.lamp)
    mesh = mi.Mesh(props.id(), count, len(table.lamp), props, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = table.corners.astype(np.float32).ravel()
    uv = np.stack([np.repeat(table.lamp + 0.5, 3), np.full(count, 0.5)], axis=-1)
    params["vertex_texcoords"] = uv.astype(np.float32).ravel()
    params["faces"] = np.arange(count, dtype=np.uint32)
    params.update()
    return mesh


@cache
def _emitter(variant: str) -> type:
    """The emitter's class for a variant, which must be the current one. Each variant has its own base classes."""

    class Lamps(mi.Emitter):
        """Many area lamps of one mesh, each with its own radiance. They shine on the side to which their faces turn.

        A face is sampled in proportion to its area times its mean radiance, and points on it uniformly.
        """

        def __init__(self, table: LampFaces):
            super().__init__(mi.Properties())
            self.table = table
            corners, lamp, radiance = table.corners, table.lamp, table.radiance
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            areas = np.linalg.norm(across, axis=-1) / 2
            strength = np.abs(radiance).mean(axis=-1)
            # If all lamps are dark, they must still have a distribution.
            strength = strength if strength.any() else np.ones(len(strength))
            share = areas * strength[lamp]
            upto = np.cumsum(share / share.sum())
            # From the last face that may be sampled, the bound exceeds any random number, so no later face is chosen.
            upto[np.flatnonzero(share)[-1] :] = 2
            self.faces, self.upto = len(areas), mi.Float(upto.astype(np.float32))
            self.corners, self.lamp = mi.Float(corners.astype(np.float32).ravel()), mi.UInt32(lamp.astype(np.uint32))
            self.radiance = mi.Float(radiance.astype(np.float32).ravel())
            self.per_area = mi.Float((strength / share.sum()).astype(np.float32))
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
            self.m_needs_sample_2 = self.m_needs_sample_3 = True

        def _emitted(self, uv: mi.Point2f, active) -> mi.Color3f:
            return dr.gather(mi.Color3f, self.radiance, mi.UInt32(uv.x), active)

        def _place(self, time: mi.Float, sample: mi.Point2f, active) -> mi.PositionSample3f:
            face = dr.binary_search(0, self.faces - 1, lambda i: dr.gather(mi.Float, self.upto, i, active) <= sample.x)
            before = dr.gather(mi.Float, self.upto, face - 1, active & (face > 0))
            upto = dr.minimum(dr.gather(mi.Float, self.upto, face, active), 1)
            left = dr.clip((sample.x - before) / dr.maximum(upto - before, 1e-20), 0, dr.one_minus_epsilon(mi.Float))
            b = mi.warp.square_to_uniform_triangle(mi.Point2f(left, sample.y))
            a, e1, e2 = (dr.gather(mi.Point3f, self.corners, 3 * face + i, active) for i in range(3))
            e1, e2 = mi.Vector3f(e1 - a), mi.Vector3f(e2 - a)
            lamp = dr.gather(mi.UInt32, self.lamp, face, active)
            place = dr.zeros(mi.PositionSample3f, dr.width(sample))
            place.p, place.n = a + e1 * b.x + e2 * b.y, mi.Normal3f(dr.normalize(dr.cross(e1, e2)))
            place.uv, place.time = mi.Point2f(mi.Float(lamp) + 0.5, 0.5), time
            place.pdf = dr.gather(mi.Float, self.per_area, lamp, active)
            return place

        def sample_position(self, time, sample, active=True):
            place = self._place(time, sample, active)
            return place, dr.select(active & (place.pdf > 0), dr.rcp(place.pdf), 0)

        def pdf_position(self, ps, active=True):
            return dr.gather(mi.Float, self.per_area, mi.UInt32(ps.uv.x), active)

        def sample_direction(self, it, sample, active=True):
            place = self._place(it.time, sample, active)
            light = mi.DirectionSample3f(place)
            to = mi.Vector3f(place.p - it.p)
            light.dist = dr.norm(to)
            light.d = to / light.dist
            light.emitter = mi.EmitterPtr(self)
            light.pdf = self.pdf_direction(it, light, active)
            active = active & (light.pdf > 0)
            return light, dr.select(active, self._emitted(place.uv, active) / light.pdf, 0)

        def pdf_direction(self, it, ds, active=True):
            cos = -dr.dot(ds.d, ds.n)
            active = active & (cos > 0)
            return dr.select(active, self.pdf_position(ds, active) * dr.square(ds.dist) / cos, 0)

        def eval_direction(self, it, ds, active=True):
            active = active & (dr.dot(ds.d, ds.n) < 0)
            return dr.select(active, self._emitted(ds.uv, active), 0)

        def eval(self, si, active=True):
            active = active & (si.wi.z > 0)
            return dr.select(active, self._emitted(si.uv, active), 0)

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            place = self._place(time, sample2, active)
            si = mi.SurfaceInteraction3f(place, dr.zeros(mi.Wavelength))
            d = si.to_world(mi.warp.square_to_cosine_hemisphere(sample3))
            weight = dr.select(place.pdf > 0, self._emitted(place.uv, active) * (dr.pi / place.pdf), 0)
            return si.spawn_ray(d), weight

        def sample_wavelengths(self, si, sample, active=True):
            return dr.zeros(mi.Wavelength), self.eval(si, active)

        def bbox(self):
            return self.get_shape().bbox()

        def to_string(self):
            return f"Lamps[{len(self.table.radiance)}]"

    return Lamps
