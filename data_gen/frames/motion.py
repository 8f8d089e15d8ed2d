"""Motion vectors. A motion vector leads from a pixel to the place on the film where the point that the pixel shows was
one frame before.

A pixel shows the first smoothly scattering point on the ray through its centre. The hit is looked up in the scene of
the frame before by shape, primitive and barycentric coordinates, which works for any deformation of a mesh. Instances,
and shapes that are no meshes, move by their ``to_world``. A ``Snapshot`` keeps the geometry of the scene before.

The motion of a thing seen in a mirror or through glass is that of its apparent place: the end of a straight ray as long
as the path. This is exact for plane mirrors in a scene at rest. It ignores the motion of things seen in curved mirrors.
Rays that escape show points at infinity. Surfaces count, media do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import recording
from data_gen.paths.features import first_nonspecular_vertex
from data_gen.scenes.cameras import camera_name, place_of
from data_gen.scenes.geometry import Geometry, Triangles, geometry, matrix
from ngpt.errors import NgptError
from ngpt.windows import Place

# A hit that is farther off the straight ray than this, relative to the path's length, was seen in a mirror or through
# glass.
_OFF_RAY = 1e-3


@dataclass(frozen=True)
class Snapshot:
    shapes: tuple[Geometry, ...]  # in the order of ``scene.shapes()``
    film: np.ndarray  # (4, 4): homogeneous points of the world to (x, y, -, 1) in pixels, the last positive in front
    place: Place  # where the pixels lie


def snapshot(scene: mi.Scene, shapes: tuple[Geometry, ...] | None = None) -> Snapshot:
    """The state of a scene; ``shapes`` are those of an earlier snapshot, if they are known not to have changed
    since."""
    if shapes is None:
        shapes = tuple(geometry(shape) for shape in scene.shapes())
    sensor = scene.sensors()[0]
    return Snapshot(shapes, _film(sensor), place_of(sensor))


def _film(sensor: mi.Sensor) -> np.ndarray:
    """The projection of a camera onto its film, in pixels of the crop window."""
    params, film = mi.traverse(sensor), sensor.film()
    if "x_fov" not in params:
        what = "motion vectors need a perspective or thinlens camera; render single images, without --frames"
        raise NgptError(f"camera '{camera_name(sensor)}': {what}")
    near, far = sensor.near_clip(), sensor.far_clip()
    fov = float(np.array(params["x_fov"]).ravel()[0])
    projection = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), fov, near, far)
    pixels = np.diag([*(float(n) for n in film.crop_size()), 1, 1])
    for axis, name in enumerate(("principal_point_offset_x", "principal_point_offset_y")):
        if name in params:
            # The offset refers to the whole film, whatever its crop window.
            pixels[axis, 3] = -float(np.array(params[name]).ravel()[0]) * film.size()[axis]
    return pixels @ matrix(projection) @ np.linalg.inv(matrix(params["to_world"]))


class _Middle:
    """A sampler that always returns 0.5, so that a path always takes the likelier of two ways."""

    def next_1d(self, active=True) -> mi.Float:
        return mi.Float(0.5)

    def next_2d(self, active=True) -> mi.Point2f:
        return mi.Point2f(0.5)


@dataclass(frozen=True)
class CentreHits:
    """The hits of the rays through the centres of all N pixels, row by row."""

    points: np.ndarray  # (N, 4) homogeneous, in the world: apparent places, or directions where rays escape
    straight: np.ndarray  # (N,) whether the hit is at its apparent place, with no mirror or lens on the way
    shape: np.ndarray  # (N,) number of the shape in ``scene.shapes()``, -1 where rays escape
    primitive: np.ndarray  # (N,) number of the triangle
    barycentric: np.ndarray  # (N, 2) weights of its second and third vertex


def seen(scene: mi.Scene) -> CentreHits:
    """The points that the pixels of the first sensor show in the middle of its exposure."""
    sensor = scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    with recording():
        lane = dr.arange(mi.UInt32, width * height)
        columns = dr.opaque(mi.UInt32, width)
        centre = mi.Point2f(lane % columns, lane // columns) + 0.5
        time = sensor.shutter_open() + 0.5 * sensor.shutter_open_time()
        uv = centre / mi.Vector2f(dr.opaque(mi.Float, width), dr.opaque(mi.Float, height))
        ray, _ = sensor.sample_ray_differential(time, 0.5, uv, mi.Point2f(0.5))
        si, last, depth, _, _ = first_nonspecular_vertex(scene, _Middle(), ray)
        valid = si.is_valid()
        hit = scene.ray_intersect_preliminary(last, active=valid)
        whole = dr.select(hit.instance == None, hit.shape, hit.instance)  # noqa: E711 - arrays of pointers
        number = dr.reinterpret_array(mi.UInt32, whole)
        place = si.p
        dr.eval(ray.o, ray.d, place, depth, valid, number, hit.prim_index, hit.prim_uv)
    valid = np.broadcast_to(np.array(valid), width * height)
    o, d, place = (np.array(v, np.float64).T.reshape(-1, 3) for v in (ray.o, ray.d, place))
    depth = np.where(valid, np.array(depth, np.float64), 0)[:, None]
    apparent = o + d * depth
    straight = valid & (np.abs(apparent - place).max(axis=1) <= _OFF_RAY * np.maximum(depth[:, 0], 1e-30))
    points = np.concatenate([np.where(valid[:, None], apparent, d), valid[:, None]], axis=1)
    ids = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
    numbers = np.full(max(int(ids.max(initial=0)), int(np.array(number).max(initial=0))) + 1, -1)
    numbers[ids] = np.arange(len(ids))
    shape = np.where(valid, numbers[np.array(number)], -1)
    uv = np.array(hit.prim_uv, np.float64).T.reshape(-1, 2)
    return CentreHits(points, straight, shape, np.array(hit.prim_index), uv)


def depth(scene: mi.Scene, now: Snapshot, what: CentreHits) -> np.ndarray:
    """(H, W): apparent distance along the camera's axis, in units of its own space; infinite where rays escape."""
    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    return np.where(what.shape >= 0, what.points @ now.film[3], np.inf).reshape(height, width)


def motion_vectors(scene: mi.Scene, now: Snapshot, before: Snapshot, what: CentreHits | None = None) -> np.ndarray:
    """(H, W, 2) float32: motion in pixels from each pixel to its point in the frame ``before``; x right, y down.

    Both places are counted in pixels of the crop windows. Add ``window_moved`` for the motion in the whole picture.
    ``now`` is the snapshot of ``scene``, and ``what`` is ``seen(scene)`` if that is known. The motion is NaN where it
    is not known: for points behind the previous camera, or on a shape that did not exist.
    """
    what = seen(scene) if what is None else what
    moved = what.points.copy()
    unknown = np.zeros(len(moved), bool)
    if now.shapes is not before.shapes:
        for index in np.unique(what.shape[what.shape >= 0]):
            here = np.flatnonzero(what.shape == index)
            old = before.shapes[index] if index < len(before.shapes) else None
            shift = _displacement(now.shapes[index], old, what, here)
            if shift is None:
                unknown[here] = True
            else:
                moved[here, :3] += np.where(what.straight[here, None], shift, 0)
    (x, y, _), front = _project(now.film, what.points)
    (x_before, y_before, _), front_before = _project(before.film, moved)
    motion = np.stack([x_before - x, y_before - y], axis=-1)
    motion[unknown | ~front | ~front_before] = np.nan
    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    return motion.reshape(height, width, 2).astype(np.float32)


def window_moved(now: Snapshot, before: Snapshot) -> tuple[int, int]:
    """Pixels (x, y) by which the crop window of ``before`` is further right and down than the one of ``now``."""
    (x, y), (x_before, y_before) = now.place.data.corner, before.place.data.corner
    return x_before - x, y_before - y


def _displacement(now: Geometry, old: Geometry, what: CentreHits, here: np.ndarray) -> np.ndarray | None:
    """(n, 3) from the points of a shape seen by the pixels ``here`` to their previous places; None if not known."""
    if isinstance(now, Triangles) and isinstance(old, Triangles) and now.faces.shape == old.faces.shape:
        b1, b2 = what.barycentric[here].T
        weights = np.stack([1 - b1 - b2, b1, b2], axis=-1)[..., None]
        triangles = what.primitive[here]
        return ((old.vertices[old.faces[triangles]] - now.vertices[now.faces[triangles]]) * weights).sum(axis=1)
    if isinstance(now, np.ndarray) and isinstance(old, np.ndarray):
        if np.array_equal(now, old):
            return np.zeros((len(here), 3))
        points = what.points[here]
        return ((old @ np.linalg.inv(now) @ points.T).T - points)[:, :3]
    return None if now is not None or old is not None else np.zeros((len(here), 3))


def _project(film: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, N) pixel coordinates of homogeneous points (N, 4), and which of them are in front of the camera."""
    x, y, z, w = film @ points.T
    front = w > 0
    w = np.where(front, w, 1)
    return np.stack([x / w, y / w, z / w]), front
