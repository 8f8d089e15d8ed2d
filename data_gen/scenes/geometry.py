"""The geometry of a scene's shapes: matrices and meshes, as NumPy arrays that outlive the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Triangles:
    """Vertices (V, 3) and triangles (F, 3) of a shape, in the world."""

    vertices: np.ndarray
    faces: np.ndarray


# Names of the parameter with a mesh's vertices: rows of three numbers since Mitsuba 3.10, a flat array before
VERTICES = ("positions", "vertex_positions")

# A matrix (4, 4) to world space, or a mesh, or None for shapes that expose neither of them
Geometry = np.ndarray | Triangles | None


def geometry(shape: mi.Shape) -> Geometry:
    return geometry_of(mi.traverse(shape))


def geometry_of(params: Mapping[str, Any]) -> Geometry:
    if "to_world" in params:
        return matrix(params["to_world"])
    if (name := vertices_name(params)) and "faces" in params:
        return Triangles(vertices(params, name), np.array(params["faces"]).reshape(-1, 3))
    return None


def vertices_name(params: Mapping[str, Any], shape: str = "") -> str:
    """The name of the parameter with the vertices of a mesh, or ""; ``shape`` is the mesh's name in the scene."""
    names = (f"{shape}.{name}" if shape else name for name in VERTICES)
    return next((name for name in names if name in params), "")


def vertices(params: Mapping[str, Any], name: str) -> np.ndarray:
    """A copy of the vertices (V, 3) that a parameter holds. An updated scene overwrites its buffers."""
    return np.array(params[name], np.float64).reshape(-1, 3)


def put_vertices(params: Any, name: str, moved: np.ndarray) -> None:
    params[name] = type(params[name])(np.ascontiguousarray(moved, np.float32).reshape(np.shape(params[name])))


def matrix(transform) -> np.ndarray:
    return np.array(transform.matrix, np.float64).reshape(4, 4, -1)[..., 0]
