"""Where the shapes of a scene are: matrices and meshes, as NumPy arrays that outlive the scene."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3) and triangles (F, 3) of a shape, in the world."""

    vertices: np.ndarray
    faces: np.ndarray


# A matrix (4, 4) to the world, or a mesh; None for shapes that show neither.
Geometry = np.ndarray | Mesh | None


def geometry(shape: mi.Shape) -> Geometry:
    params = mi.traverse(shape)
    if "to_world" in params:
        return matrix(params["to_world"])
    if "vertex_positions" in params and "faces" in params:
        # Copies, for a scene that is updated keeps its buffers.
        vertices = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
        return Mesh(vertices, np.array(params["faces"]).reshape(-1, 3))
    return None


def matrix(transform) -> np.ndarray:
    return np.array(transform.matrix, np.float64).reshape(4, 4, -1)[..., 0]
