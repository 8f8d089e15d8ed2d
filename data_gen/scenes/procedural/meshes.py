"""Triangle meshes made in code, with texture coordinates in metres, and a PLY writer for them.

Every mesh has normals and texture coordinates, so that all meshes use the same kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Mesh:
    """``vertices`` and ``normals`` (n, 3), ``uvs`` (n, 2), ``faces`` (m, 3) indices, counter-clockwise from outside."""

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray

    def transformed(self, matrix: np.ndarray) -> Mesh:
        """The mesh after a (3, 4) or (4, 4) affine ``matrix`` without reflections."""
        linear = matrix[:3, :3]
        normals = _unit(self.normals @ np.linalg.inv(linear))
        return Mesh(self.vertices @ linear.T + matrix[:3, 3], normals, self.uvs, self.faces)

    def placed(self, position, angle: float = 0.0, scale=1.0) -> Mesh:
        """The mesh scaled, turned by ``angle`` radians about the vertical, and moved to ``position``."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation([0, 1, 0], angle) @ np.diag(np.broadcast_to(scale, 3))
        matrix[:3, 3] = position
        return self.transformed(matrix)


def merge(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uvs for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def rotation(axis, angle: float) -> np.ndarray:
    """(3, 3) rotation by ``angle`` radians about ``axis`` (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def quads(corners) -> Mesh:
    """Flat quads with corners (n, 4, 3), counter-clockwise from the front."""
    corners = np.asarray(corners, float).reshape(-1, 4, 3)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normals = np.repeat(_unit(np.cross(u, v)), 4, axis=0)
    width, height = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    zero = np.zeros_like(width)
    uvs = np.stack([zero, zero, width, zero, width, height, zero, height], axis=1).reshape(-1, 2)
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(corners.reshape(-1, 3), normals, uvs, faces)


def box(size, center=(0, 0, 0)) -> Mesh:
    """An axis-aligned box of ``size`` = (x, y, z) metres."""
    x, y, z = np.asarray(size, float) / 2
    corner = np.array([[i, j, k] for k in (-z, z) for j in (-y, y) for i in (-x, x)]) + center
    sides = [[4, 5, 7, 6], [1, 0, 2, 3], [5, 1, 3, 7], [0, 4, 6, 2], [6, 7, 3, 2], [0, 1, 5, 4]]
    return quads(corner[np.array(sides)])


def wall(origin, u, v, openings=()) -> Mesh:
    """A wall from ``origin`` along the edges ``u``, ``v`` (front: u x v), with rectangular openings cut out.

    An opening is (u0, u1, v0, v1), in fractions of the edges. Openings must not overlap in u.
    """
    origin, u, v = (np.asarray(a, float) for a in (origin, u, v))
    cells, end = [], 0.0
    for u0, u1, v0, v1 in sorted(openings):
        cells += [(end, u0, 0, 1), (u0, u1, 0, v0), (u0, u1, v1, 1)]
        end = u1
    cells.append((end, 1, 0, 1))
    corners = [[(a, c), (b, c), (b, d), (a, d)] for a, b, c, d in cells if b > a and d > c]
    mesh = quads([[origin + s * u + t * v for s, t in corner] for corner in corners])
    offset = mesh.vertices - origin
    uvs = np.stack([offset @ _unit(u), offset @ _unit(v)], axis=1)
    return Mesh(mesh.vertices, mesh.normals, uvs, mesh.faces)


def lathe(profile, segments: int = 48) -> Mesh:
    """A profile (n, 2) of (radius, height), turned about the vertical. Rising heights have their front outside."""
    profile = np.asarray(profile, float)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=1)
    points = profile[:, None, :1] * ring[None] + profile[:, None, 1:] * np.array([0, 1, 0])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    around = angle * max(profile[:, 0].max(), 1e-3)
    return surface(points, along, around)


def surface(points: np.ndarray, along=None, around=None) -> Mesh:
    """A smooth surface through a grid of ``points`` (rows, columns, 3); front: columns x rows."""
    rows, columns = points.shape[:2]
    if along is None:
        along = np.linalg.norm(points[:, 0] - points[0, 0], axis=1)
        around = np.linalg.norm(points[0] - points[0, 0], axis=1)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = points.reshape(-1, 3)
    flat = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    faces, flat = faces[np.linalg.norm(flat, axis=1) > 1e-12], flat[np.linalg.norm(flat, axis=1) > 1e-12]
    # Points that coincide (seams, poles) share a normal.
    _, same = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    sums = np.zeros((same.max() + 1, 3))
    for corner in range(3):
        np.add.at(sums, same.ravel()[faces[:, corner]], flat)
    uvs = np.stack(np.broadcast_arrays(np.asarray(around)[None, :], np.asarray(along)[:, None]), axis=-1)
    return Mesh(vertices, _unit(sums[same.ravel()]), uvs.reshape(-1, 2), faces)


def sphere(radius: float, segments: int = 48) -> Mesh:
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([np.abs(np.cos(latitude)) * (np.abs(latitude) < 1.57), np.sin(latitude)], axis=1)
    return lathe(radius * profile, segments)


def cylinder(radius: float, height: float, segments: int = 32) -> Mesh:
    """A cylinder that stands on the ground. Vertices at its rims are doubled, so that the rims look sharp."""
    side = lathe([(radius, 0), (radius, height)], segments)
    return merge([lathe([(0, 0), (radius, 0)], segments), side, lathe([(radius, height), (0, height)], segments)])


def torus(radius: float, thickness: float, segments: int = 48) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, segments // 2 + 1)
    return lathe(np.stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)], axis=1), segments)


def rock(rng: np.random.Generator, radius: float, roughness: float, segments: int = 64) -> Mesh:
    """A sphere, displaced along its normals by waves in random directions."""
    ball = sphere(radius, segments)
    unit = ball.vertices / radius
    height = np.zeros(len(unit))
    for octave in range(1, 5):
        for _ in range(4):
            direction = rng.normal(size=3)
            direction *= 1.7**octave / np.linalg.norm(direction)
            height += np.sin(unit @ direction * 2 + rng.uniform(0, 6.3)) / (4 * octave)
    points = ball.vertices * (1 + roughness * height)[:, None]
    rows = segments // 2 + 1
    return surface(points.reshape(rows, -1, 3), ball.uvs.reshape(rows, -1, 2)[:, 0, 1], ball.uvs[: segments + 1, 0])


def cloth(rng: np.random.Generator, width: float, height: float, folds: float, depth: float) -> Mesh:
    """A curtain in the x-y plane, with a corner at (0, 0) and its front toward +z."""
    x, y = np.linspace(0, width, 96), np.linspace(0, height, 16)
    phase, second = rng.uniform(0, 6.3, 2)
    wave = np.sin(x * folds + phase)[None] + 0.4 * np.sin(x[None] * folds * 2.3 + second + y[:, None])
    grid = np.broadcast_arrays(x[None, :], y[:, None], depth * wave)
    return surface(np.stack(grid, axis=-1), y, x)


def scattered_quads(rng: np.random.Generator, count: int, radius: float, size: float) -> Mesh:
    """``count`` small quads around a ball of ``radius``, turned at random: leaves."""
    center = rng.normal(size=(count, 3))
    center *= (radius * rng.uniform(0.3, 1, count) ** 0.5 / np.linalg.norm(center, axis=1))[:, None]
    u = _unit(rng.normal(size=(count, 3)))
    v = _unit(np.cross(u, rng.normal(size=(count, 3))))
    length = size * rng.uniform(0.5, 1.3, (count, 1))
    u, v = u * length / 2, v * length
    mesh = quads(np.stack([center - u - v, center + u - v, center + u + v, center - u + v], axis=1))
    # Each leaf shows the whole texture, whatever its size.
    return Mesh(mesh.vertices, mesh.normals, np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (count, 1)), mesh.faces)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary little-endian PLY, as Mitsuba's ``ply`` reads it."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    table = np.hstack([mesh.vertices, mesh.normals, mesh.uvs]).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    path.write_bytes("\n".join(header).encode() + table.tobytes() + faces.tobytes())


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-20)
