"""The ends of paths at lights: where light starts, and with which density."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.bent import BentLamps, sample_emitter
from data_gen.paths.holes import Holes
from data_gen.paths.vertex import Materials
from data_gen.scenes.lamp_mesh import is_area
from data_gen.scenes.lamps import emitter_numbers
from ngpt.errors import NgptError

# An emitter is an area, a point (spots are points that fill a cone), or infinitely far away.
AREA, POINT, FAR = 0, 1, 2


@dataclass
class LightRay:
    """The first edge of a light path, and the point on the emitter where it starts."""

    ray: mi.Ray3f
    β: mi.Spectrum  # Le cos / p
    emitter: mi.EmitterPtr
    index: mi.UInt32
    end: mi.DirectionSample3f  # position, normal, uv and pdf of the point on the emitter
    delta: mi.Bool
    front: mi.Normal3f | None = None  # the vertex normal at that point; None in scenes without bent lamps


class LightEnds:
    """The emitters of a scene as starts of light paths.

    On area lights, Mitsuba samples the point (``BentLamps`` on bent lamps), and directions have a cosine distribution.
    For emitters that are infinitely far away, Mitsuba samples the direction, and the ray starts on a disk that covers
    the scene. Directions from a point light are uniform on the sphere, directions from a spot are uniform in its cone.

    Raises NgptError, with the name of the ``sampler``, for other emitters: Mitsuba does not expose enough about them.
    """

    def __init__(self, scene: mi.Scene, sampler: str = "bdpt"):
        emitters = scene.emitters()
        kinds = [_kind(emitter) for emitter in emitters]
        for emitter, kind in zip(emitters, kinds, strict=True):
            if kind is None:
                raise NgptError(
                    f"sampler '{sampler}' cannot render this scene: light cannot be traced from emitter "
                    f"'{emitter.id()}' ({emitter.class_name()}); use --sampler gpt, or primal"
                )
        box = scene.bbox()
        self.center = mi.ScalarPoint3f(box.center())
        # The radius has a margin. Without it, rounding could leave corners of the scene outside the disk.
        self.radius = 1.001 * float(np.linalg.norm(np.array(box.extents()))) / 2
        self.kinds = set(kinds)
        self.emitters = scene.emitters_dr() if emitters else None
        self.kind = mi.UInt32(np.array(kinds or [0], np.uint32))
        self.bent = BentLamps.of(scene)
        both = zip(emitters, kinds, strict=True)
        tables = [_table(scene, number, *each) for number, each in enumerate(both)] or [[0] * 8]
        x, y, z, u, v, w, self.cutoff, of_ball = map(mi.Float, np.array(tables, np.float32).T)
        self.position, self.axis = mi.Point3f(x, y, z), mi.Vector3f(u, v, w)
        # The density of starting points per area for spheres, where a connection samples only the visible part; else 0
        self.of_ball = of_ball
        self.balls = bool(np.any(np.array(of_ball) > 0))
        self.indices = emitter_numbers(scene)
        dr.eval(self.kind, self.position, self.axis, self.cutoff, self.of_ball, self.indices)

    def index_of(self, emitter: mi.EmitterPtr, active=True) -> mi.UInt32:
        return dr.gather(mi.UInt32, self.indices, dr.reinterpret_array(mi.UInt32, emitter), active)

    def far(self, index: mi.UInt32) -> mi.Bool:
        return dr.gather(mi.UInt32, self.kind, index) == FAR

    def emission(self, index: mi.UInt32, p: mi.Float, cos: mi.Float, distance2: mi.Float) -> mi.Float:
        """``e`` of ``data_gen.samplers.bdpt.mis`` for the emitter with number ``index``.

        ``p``          density of connecting to this point of the emitter from the other end of the edge; not for deltas
        ``cos``        absolute cosine at the emitter
        ``distance2``  squared length of the edge
        """
        kind = dr.gather(mi.UInt32, self.kind, index)
        e = mi.Float(1 / (np.pi * self.radius**2))
        if POINT in self.kinds:
            e = dr.select(kind == POINT, _cone_density(dr.gather(mi.Float, self.cutoff, index)) / distance2, e)
        if AREA in self.kinds:
            area = cos / (dr.pi * distance2)
            if self.balls:
                of_ball = dr.gather(mi.Float, self.of_ball, index)
                area = dr.select(of_ball > 0, of_ball / (dr.pi * p), area)
            e = dr.select(kind == AREA, area, e)
        return e

    def connect(self, scene, si: mi.SurfaceInteraction3f, u: mi.Point2f, active) -> tuple:
        """As ``scene.sample_emitter_direction(si, u, False, active)``; the third value is ``LightRay.front``."""
        return sample_emitter(scene, self.bent, si, u, active)

    def met(self, scene, si: mi.SurfaceInteraction3f, ref, active) -> tuple[mi.DirectionSample3f, mi.Float]:
        """The emitter at ``si``, and the density with which ``connect()`` finds it from ``ref``."""
        light = mi.DirectionSample3f(scene, si, ref)
        p = scene.pdf_emitter_direction(ref, light, active)
        if self.bent:
            p, light.n = self.bent.corrected(p, light, si, scene.pdf_emitter, active)
        return light, p

    def sample(self, scene, random, time, wavelengths) -> LightRay:
        """Samples an emitter, a point on it and a direction: the first edge of a light path."""
        u, u_position, u_direction = random.next_1d(), random.next_2d(), random.next_2d()
        index, weight, _ = scene.sample_emitter(u)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index)
        kind = dr.gather(mi.UInt32, self.kind, index)
        n = dr.width(index)
        end = dr.zeros(mi.DirectionSample3f, n)
        origin, d = dr.zeros(mi.Point3f, n), mi.Vector3f(0, 0, 1)
        β, delta, front = mi.Spectrum(0), mi.Bool(False), None
        if AREA in self.kinds:
            here = kind == AREA
            place, _ = emitter.sample_position(time, u_position, here)
            if self.bent:
                front = self._place_bent(place, index, u_position, here)
            si = mi.SurfaceInteraction3f(place, wavelengths)
            si.wi = mi.warp.square_to_cosine_hemisphere(u_direction)
            Le = emitter.eval(si, here)
            β = dr.select(here & (place.pdf > 0), Le * (dr.pi * weight / place.pdf), β)
            d = dr.select(here, si.to_world(si.wi), d)
            if front is not None:
                β = dr.select(here & (dr.dot(front, d) <= 0), 0, β)
            origin = dr.select(here, si.spawn_ray(d).o, origin)
            end.p, end.n, end.uv, end.pdf = place.p, place.n, place.uv, place.pdf
        if POINT in self.kinds:
            here = kind == POINT
            cutoff = dr.gather(mi.Float, self.cutoff, index)
            frame = mi.Frame3f(dr.gather(mi.Vector3f, self.axis, index))
            position = dr.gather(mi.Point3f, self.position, index)
            along = frame.to_world(mi.warp.square_to_uniform_cone(u_direction, cutoff))
            # The intensity is the irradiance at distance 1.
            beside = _somewhere(position + along, time, wavelengths)
            _, intensity = emitter.sample_direction(beside, mi.Point2f(0.5), here)
            β = dr.select(here, intensity * (weight / _cone_density(cutoff)), β)
            origin, d, delta = dr.select(here, position, origin), dr.select(here, along, d), delta | here
            end.p = dr.select(here, position, end.p)
        if FAR in self.kinds:
            here = kind == FAR
            middle = _somewhere(mi.Point3f(self.center), time, wavelengths)
            sky, arrives = emitter.sample_direction(middle, u_position, here)
            disk = mi.warp.square_to_uniform_disk_concentric(u_direction)
            offset = mi.Frame3f(sky.d).to_world(mi.Vector3f(disk.x, disk.y, 1))
            β = dr.select(here & (sky.pdf > 0), arrives * (weight * (np.pi * self.radius**2)), β)
            origin = dr.select(here, self.center + self.radius * offset, origin)
            d = dr.select(here, -sky.d, d)
            delta |= here & sky.delta
            end.pdf = dr.select(here, sky.pdf, end.pdf)
        end.pdf /= weight
        return LightRay(mi.Ray3f(origin, d, time, wavelengths), β, emitter, index, end, delta, front)

    def _place_bent(self, place: mi.PositionSample3f, lamp: mi.UInt32, u: mi.Point2f, active) -> mi.Normal3f:
        """On bent lamps, changes ``place`` to a point that ``BentLamps`` samples. Returns ``front``, for all lamps."""
        bent = active & self.bent.has(lamp, active)
        ours, front = self.bent.point(lamp, u, bent), mi.Normal3f(place.n)
        pdf = dr.gather(mi.Float, self.bent.per_area, lamp, bent)
        for name, value in {"p": ours.p, "n": ours.n, "uv": ours.uv, "pdf": pdf}.items():
            setattr(place, name, dr.select(bent, value, getattr(place, name)))
        return mi.Normal3f(dr.select(bent, ours.front, front))

    def densities(self, scene, start: LightRay, y: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float]:
        """``e`` and ``p`` of ``data_gen.samplers.bdpt.mis``, seen from the first vertex ``y`` of a light path."""
        end, d = mi.DirectionSample3f(start.end), start.ray.d
        distance2 = dr.squared_norm(end.p - y.p)
        cos = dr.abs(dr.dot(end.n, d))
        area = dr.gather(mi.UInt32, self.kind, start.index) == AREA
        p = dr.select(area, end.pdf * distance2 / cos, end.pdf)
        if self.balls:
            end.d, end.dist, end.emitter = -d, dr.sqrt(distance2), start.emitter
            ball = area & (dr.gather(mi.Float, self.of_ball, start.index) > 0)
            p = dr.select(ball, scene.pdf_emitter_direction(y, end, ball), p)
        return self.emission(start.index, p, cos, distance2), p

    def redirected(self, scene, start: LightRay, y: mi.SurfaceInteraction3f) -> tuple[LightRay, mi.Float, mi.Float]:
        """``start`` shifted: the same point of the emitter, but the edge leads to vertex ``y``.

        Returns the shifted ray, whose β is Le cos / p with the p of ``start``; p' / p; and dω / (cos dA) with the
        cosine at y, which is 1 / distance², or 1 if the distance is infinite.
        """
        kind = dr.gather(mi.UInt32, self.kind, start.index)
        far = kind == FAR
        to = mi.Vector3f(y.p - start.end.p)
        per_distance2 = dr.select(far, 1, dr.rcp(dr.squared_norm(to)))
        d = dr.select(far, start.ray.d, dr.normalize(to))
        β, ratio = mi.Spectrum(start.β), mi.Float(1)
        if AREA in self.kinds:
            # p' / p of a cosine distribution. No light leaves the back of the emitter.
            cosines = dr.dot(start.end.n, d) / dr.dot(start.end.n, start.ray.d)
            shines = cosines > 0
            if start.front is not None:
                shines &= dr.dot(start.front, d) > 0
            ratio = dr.select(kind == AREA, dr.select(shines, cosines, 0), ratio)
            β *= ratio
        if POINT in self.kinds:
            here = kind == POINT
            beside = _somewhere(start.end.p + d, y.time, y.wavelengths)
            _, intensity = start.emitter.sample_direction(beside, mi.Point2f(0.5), here)
            density = scene.pdf_emitter(start.index) * _cone_density(dr.gather(mi.Float, self.cutoff, start.index))
            β = dr.select(here, intensity / density, β)
        ray = mi.Ray3f(start.ray.o, d, y.time, y.wavelengths)
        return LightRay(ray, β, start.emitter, start.index, start.end, start.delta, start.front), ratio, per_distance2


def _kind(emitter: mi.Emitter) -> int | None:
    """The kind of an emitter; None if light paths cannot start there."""
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
        return FAR
    if is_area(emitter):
        return AREA
    return POINT if emitter.class_name() in ("PointLight", "SpotLight") else None


def _table(scene: mi.Scene, number: int, emitter: mi.Emitter, kind: int) -> list[float]:
    """Position, axis and cosine of the cutoff of a point or spot. The last entry is the density of starts on a
    sphere."""
    if kind == AREA:
        shape = emitter.get_shape()
        ball = shape.class_name() == "Sphere"
        density = float(scene.pdf_emitter(mi.UInt32(number))[0] / shape.surface_area()[0]) if ball else 0.0
        return [0, 0, 0, 0, 0, 1, -1, density]
    if kind == POINT:
        position = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))[0].p
        params = mi.traverse(emitter)
        axis, cutoff = mi.Vector3f(0, 0, 1), -1.0
        if emitter.class_name() == "SpotLight":
            axis = dr.normalize(params["to_world"] @ mi.Vector3f(0, 0, 1))
            cutoff = float(np.cos(np.radians(float(np.array(params["cutoff_angle"]).ravel()[0]))))
        return [*np.array(position).ravel(), *np.array(axis).ravel(), cutoff, 0]
    return [0, 0, 0, 0, 0, 1, -1, 0]


def _cone_density(cutoff: mi.Float) -> mi.Float:
    """The density of uniform directions in a cone. ``cutoff`` is the cosine of its half angle; -1 is a sphere."""
    return dr.rcp(dr.two_pi * (1 - cutoff))


def _somewhere(position: mi.Point3f, time, wavelengths) -> mi.Interaction3f:
    """A point that is on no surface."""
    it = dr.zeros(mi.Interaction3f, dr.width(position))
    it.t, it.p, it.time, it.wavelengths = 0, position, time, wavelengths
    return it


@dataclass
class World:
    """A scene and its tables, which a render does not change. Functions that are ``frozen`` take it as one argument."""

    scene: mi.Scene
    lights: LightEnds
    materials: Materials | None = None  # None for samplers that do not use them
    fog: Any = None  # a ``data_gen.samplers.photons.map.fog.Fog``: the media, for samplers that gather photons there
    holes: Holes | None = None  # the holes, if they are no vertices; else None
