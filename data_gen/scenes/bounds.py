"""Bounding boxes of meshes that Mitsuba has merged: it leaves out rectangles.

``mi.load_file`` and ``mi.load_dict`` merge meshes of one material (``optimize=True``). The box of the result then lacks
each rectangle among them (Mitsuba 3.9), and with it the box of the scene. Light from far away starts on a sphere around
that box: where the sphere is too small, sun and sky pass through walls.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from data_gen.scenes.geometry import Mesh, geometry, vertices_name
from ngpt.errors import NgptError


def mend_bounds(scene: mi.Scene) -> None:
    """Computes wrong boxes of a scene's meshes again, and what depends on them.

    Raises NgptError for a mesh whose box stays wrong.
    """
    wrong = [shape for shape in scene.shapes() if shape.class_name() == "Mesh" and not bounded(shape)]
    if not wrong:
        return
    for shape in wrong:
        _compute_again(shape)
        if not bounded(shape):
            raise NgptError(
                f"the bounding box of mesh '{shape.id()}' does not contain its {shape.vertex_count()} vertices, so "
                "light from far away would pass through walls; load the scene with optimize=False"
            )
    scene.parameters_changed()
    for end in (*scene.emitters(), *scene.sensors()):
        end.set_scene(scene)  # which keeps a sphere around the scene


def bounded(shape: mi.Shape) -> bool:
    """Whether the box of a mesh contains all its vertices that are finite."""
    found, box = geometry(shape), shape.bbox()
    if not isinstance(found, Mesh):
        return True
    finite = found.vertices[np.isfinite(found.vertices).all(axis=1)]
    return bool((finite >= np.array(box.min)).all() and (finite <= np.array(box.max)).all())


def _compute_again(shape: mi.Shape) -> None:
    params = mi.traverse(shape)
    params.set_dirty(vertices_name(params))
    params.update()
