"""Cameras in the free space of any scene, found by casting rays.

The scene's own camera stands in free space. From there a walk follows random rays, each for a part of the way to its
hit. So it never enters an object and stays in reachable space. Views that see nothing are rejected. If hardly any
view sees something, as around an object in empty space, a camera stands between the scene's own camera and a point that
this camera sees, and looks at another such point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.samplers.reused import Made
from ngpt.errors import NgptError

VIRTUAL_SIZE = (1280, 720)
MAX_ZOOM = 4.0  # the crop is 1 to 1 / 4 of the virtual image's height
STEPS = 4  # of the walk to a new position
ATTEMPTS = 64
CHOICES = 5  # views from which one is chosen
GRID = 24  # rays along each side of a view, to judge it
FEWEST_EDGES = 0.04
MOST_BOUNDARIES = 8  # boundaries of media through which a ray is followed


@dataclass(frozen=True)
class CameraView:
    """A camera and the window of its virtual image that is rendered. These numbers reproduce the view."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float  # degrees along x of the virtual image
    aperture: float
    focus: float
    film: tuple[int, int]  # the virtual image, pixels
    window: tuple[int, int]  # upper left corner of the window in the virtual image
    size: int

    def apply(self, scene: mi.Scene) -> None:
        params = mi.traverse(scene.sensors()[0])
        params["to_world"] = mi.ScalarTransform4f().look_at(list(self.origin), list(self.target), list(self.up))
        params["x_fov"] = self.fov
        # A new film size resets the window to the whole film, so the window is set afterwards.
        params["film.crop_offset"] = [0, 0]
        params["film.size"] = list(self.film)
        params.update()
        params["film.crop_size"] = [self.size, self.size]
        params["film.crop_offset"] = list(self.window)
        if "aperture_radius" in params:
            # Opaque: as literals they would be compiled into the kernel, so each view would need a new one.
            params["aperture_radius"] = dr.opaque(mi.Float, self.aperture)
            params["focus_distance"] = dr.opaque(mi.Float, self.focus)
        params.update()

    @classmethod
    def of(cls, record: dict) -> CameraView:
        values: dict[str, Any] = {n: tuple(value) if isinstance(value, list) else value for n, value in record.items()}
        return cls(**values)


class Surroundings:
    """Ray casting in a scene, the ``scale`` of the scene around its camera, and the samplers ``made`` for it."""

    def __init__(self, scene: mi.Scene, box: list | tuple | None = None):
        self.scene, self.box, self.made = scene, box, Made()
        sensor = mi.traverse(scene.sensors()[0])
        matrix = np.array(sensor["to_world"].matrix, float).reshape(4, 4)
        self.start, self.up, self.fov = matrix[:3, 3], matrix[:3, 1], float(np.ravel(sensor["x_fov"])[0])
        bounds = scene.bbox()
        self.reach = float(np.linalg.norm(np.array(bounds.max) - np.array(bounds.min)))
        self.boundaries = any(is_boundary(shape.bsdf()) for shape in scene.shapes() if shape.bsdf())
        distance = self.cast(np.tile(self.start, (4096, 1)), directions(np.random.default_rng(0), 4096))[0]
        hits = distance[np.isfinite(distance)]
        if not len(hits):
            raise NgptError("the scene's camera sees nothing in any direction; move it among the objects")
        # Not from the bounding box, which a ground plane can make arbitrarily large
        self.scale = float(np.median(hits))
        self.seen = self.points(scene.sensors()[0])

    def points(self, sensor: mi.Sensor) -> np.ndarray:
        """The points (n, 3) where rays through a grid of the sensor's film hit a surface or a boundary of a medium."""
        origins, towards = grid_rays(sensor)
        distance = self.cast(origins, towards, boundaries=True)[0]
        hit = np.isfinite(distance)
        return origins[hit] + distance[hit, None] * towards[hit]

    def cast(
        self, origins: np.ndarray, towards: np.ndarray, boundaries: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances (n,), Inf if nothing is hit; normals (n, 3); identities of the shapes (n,), 0 if nothing is hit.

        Boundaries of media are invisible and count only with ``boundaries``.
        """
        ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(towards.T))
        si = self.scene.ray_intersect(ray)
        passed = mi.Float(0)
        for _ in range(MOST_BOUNDARIES if self.boundaries and not boundaries else 0):
            behind = si.is_valid() & is_boundary(si.bsdf())
            # Evaluated in each step, so that all steps share one small kernel
            if not dr.any(behind):
                break
            passed += dr.select(behind, si.t, 0)
            ray = dr.select(behind, si.spawn_ray(ray.d), ray)
            si = dr.select(behind, self.scene.ray_intersect(ray, behind), si)
            dr.eval(si, ray, passed)
        identity = dr.reinterpret_array(mi.UInt32, si.shape)
        return np.array(si.t + passed), np.array(si.n).T, np.array(identity)

    def position(self, rng: np.random.Generator) -> np.ndarray:
        """A point in free space: uniform in the given box if there is one, else the end of a walk."""
        if self.box is not None:
            low, high = self.box
            return rng.uniform(low, high)
        point = self.start
        for towards in directions(rng, STEPS):
            towards = towards - 0.5 * (towards @ self.up) * self.up
            towards /= np.linalg.norm(towards)
            # The walk does not cross boundaries, since the scene states the camera's medium once for all views.
            distance = float(self.cast(point[None], towards[None], boundaries=True)[0][0])
            point = point + rng.uniform(0.05, 0.8) * min(distance, 1.5 * self.scale) * towards
        return point


def is_boundary(bsdf: mi.BSDF | mi.BSDFPtr):
    """Whether the material only bounds media and lets all light through."""
    return bsdf.flags() & int(mi.BSDFFlags.All) == int(mi.BSDFFlags.Null)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) unit vectors, uniform on the sphere."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def grid_rays(sensor: mi.Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (GRID², 3) of rays through the film, row by row."""
    n = GRID
    grid = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) + 0.5) / n
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(grid.T), mi.Point2f(0.5))
    towards = np.array(ray.d).T
    return np.broadcast_to(np.array(ray.o).T, towards.shape), towards


def find_view(around: Surroundings, rng: np.random.Generator, size: int, roll: float, lens: float) -> CameraView:
    """A random view that shows something. Views that show more edges are more likely.

    ``size`` is the size of the crop in pixels, ``roll`` the largest angle about the view direction in degrees, and
    ``lens`` the standard deviation of the aperture's radius, relative to the focus distance (0.005 in the paper).
    Raises NgptError if no view is found.
    """
    views: list[CameraView] = []
    details: list[float] = []
    for attempt in range(2 * ATTEMPTS):
        if attempt == ATTEMPTS and views:
            break
        view = random_view(around, rng, size, roll, lens, aimed=attempt >= ATTEMPTS and len(around.seen) > 0)
        detail = what_shows(around, view)
        if detail > 0:
            views.append(view)
            details.append(detail)
        if len(views) == CHOICES:
            break
    if not views:
        raise NgptError(
            f"no view that shows anything in {2 * ATTEMPTS} attempts; give the scene a camera box in the config"
        )
    weights = np.array(details)
    return with_one_kernel(around, views[int(rng.choice(len(views), p=weights / weights.sum()))])


def random_view(
    around: Surroundings, rng: np.random.Generator, size: int, roll: float, lens: float, aimed: bool = False
) -> CameraView:
    """Any view, or a view ``aimed`` at points that the scene's own camera sees."""
    if aimed:
        before, target = around.seen[rng.integers(len(around.seen), size=2)]
        origin = around.start + rng.uniform(0, 0.6) * (before - around.start)
        towards = target - origin
    else:
        origin = around.position(rng)
        towards = directions(rng, 1)[0]
        towards = towards - 0.7 * (towards @ around.up) * around.up
    towards /= np.linalg.norm(towards)
    distance = float(around.cast(origin[None], towards[None])[0][0])
    focus = distance if np.isfinite(distance) else around.scale
    angle = np.radians(rng.uniform(-roll, roll))
    side = np.cross(towards, around.up)
    up = np.cos(angle) * around.up + np.sin(angle) * side / max(np.linalg.norm(side), 1e-6)
    scale = size / VIRTUAL_SIZE[1] * MAX_ZOOM ** rng.random()
    film = max(size, round(scale * VIRTUAL_SIZE[0])), max(size, round(scale * VIRTUAL_SIZE[1]))
    window = int(rng.integers(0, film[0] - size + 1)), int(rng.integers(0, film[1] - size + 1))
    fov = float(np.clip(around.fov * rng.uniform(0.7, 1.2), 15, 100))
    aperture = max(abs(rng.normal(0, lens)), 1e-5) * focus
    target = floats(origin + focus * towards)
    return CameraView(floats(origin), target, floats(up), fov, float(aperture), float(focus), film, window, size)


def floats(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def with_one_kernel(around: Surroundings, view: CameraView) -> CameraView:
    """The view, or a nearly equal one, with which all views of a scene share their kernels.

    Pixels are square, so two factors of the camera's projection are equal except for rounding. If they are equal to the
    last bit, Dr.Jit treats them as one variable, and compiles all kernels again, which takes many seconds.
    """
    params = mi.traverse(around.scene.sensors()[0])
    crop, corner = mi.ScalarVector2i(view.size, view.size), mi.ScalarVector2i(*view.window)
    # Some sizes have equal factors for any field of view: all sizes with the height of the crop.
    for larger in range(16):
        width, height = view.film[0] + larger, view.film[1] + larger
        for steps in range(8):
            fov = np.float32(view.fov) * np.float32(1 + steps * 1e-6)
            projection = mi.perspective_projection(
                mi.ScalarVector2i(width, height), crop, corner, mi.Float(fov), params["near_clip"], params["far_clip"]
            )
            factors = projection.inverse().matrix
            if factors[0, 0] != factors[1, 1]:
                return replace(view, fov=float(fov), film=(width, height))
    return view


def what_shows(around: Surroundings, view: CameraView) -> float:
    """The share of edges in a view, or 0 if it is mostly empty, very close to something, or one flat surface."""
    view.apply(around.scene)
    n = GRID
    distance, normal, shape = around.cast(*grid_rays(around.scene.sensors()[0]))
    hit = np.isfinite(distance)
    if hit.mean() < 0.35 or np.quantile(distance[hit], 0.1) < 0.06 * around.scale:
        return 0.0
    # Edges: neighbours that differ in their shape or their normal
    shape, normal = shape.reshape(n, n), np.where(hit[:, None], normal, 0).reshape(n, n, 3)
    other = [(np.diff(shape, axis=a) != 0) | (np.linalg.norm(np.diff(normal, axis=a), axis=-1) > 0.2) for a in (0, 1)]
    edges = float(np.mean([edge.mean() for edge in other]))
    return edges if edges > FEWEST_EDGES else 0.0
