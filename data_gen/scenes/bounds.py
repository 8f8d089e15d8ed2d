"""Corrects the bounding boxes of meshes that Mitsuba has merged.

``mi.load_file`` and ``mi.load_dict`` merge meshes of one material (``optimize=True``), and so does ``load_scene``. In
Mitsuba 3.9 the box of a merged mesh leaves out all rectangles in it, and so does the box of the scene. Light from far
away starts on a sphere around that box. If the sphere is too small, sun and sky pass through walls.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from data_gen.scenes.geometry import vertices_name
from ngpt.errors import NgptError


def mend_bounds(scene: mi.Scene) -> None:
    """Corrects wrong bounding boxes of a scene's meshes, and updates everything that depends on them.

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
        end.set_scene(scene)  # updates its sphere around the scene


def bounded(shape: mi.Shape) -> bool:
    """Whether the box of a mesh contains all its vertices, ignoring NaN coordinates."""
    params, box = mi.traverse(shape), shape.bbox()
    corners = np.array(params[vertices_name(params)]).reshape(-1, 3)
    return not ((corners < np.array(box.min)).any() or (corners > np.array(box.max)).any())


def _compute_again(shape: mi.Shape) -> None:
    params = mi.traverse(shape)
    params.set_dirty(vertices_name(params))
    params.update()
