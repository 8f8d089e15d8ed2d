"""Finds lamps whose light is hard to find or wrong in Mitsuba, and the surfaces that cause it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from data_gen.scenes.facts import shapes_of
from data_gen.scenes.integrators import objects_in
from data_gen.scenes.lamp_mesh import table_of

_SHARP = ("SmoothConductor", "SmoothDielectric")
# Lamps smaller than this share of the scene's diagonal are met by hardly any path.
_TINY = 1 / 500
# Part of the class name of all emitters with a sun, whose disk fills 7e-5 of a hemisphere.
_SUN = "Sunsky"
# Vertex normals count as different from face normals if the mean cosine between them is below this (2.6 degrees).
_BENT = 0.999


def behind_sharp(scene: mi.Scene) -> str:
    """The kind of the scene's lamps that camera paths hardly meet behind its glass or mirrors.

    "" if the scene has no clear glass or mirrors, or no lamps of this kind.
    """
    if not any(_is_sharp(shape.bsdf()) for shape in shapes_of(scene)):
        return ""
    if without_size(scene):
        return "lamps without size"
    return "tiny lamps" if any(hard_to_meet(scene, emitter) for emitter in scene.emitters()) else ""


def without_size(scene: mi.Scene) -> bool:
    return any(map(_has_no_size, scene.emitters()))


def hard_to_meet(scene: mi.Scene, emitter: mi.Emitter) -> bool:
    """Whether paths hardly meet this emitter of the scene, because it has no size or is tiny."""
    return _has_no_size(emitter) or _is_tiny(emitter, float(np.linalg.norm(np.array(scene.bbox().extents()))))


def _has_no_size(emitter: mi.Emitter) -> bool:
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)


def has_holes(scene: mi.Scene) -> bool:
    """Whether light goes straight through a surface of the scene; boundaries of media do not count."""
    bsdfs = (shape.bsdf() for shape in shapes_of(scene) if not shape.is_medium_transition())
    return any(bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)


def bent_lamp(scene: mi.Scene) -> mi.Shape | None:
    """The first lamp whose vertex normals differ from its face normals, or None.

    Mitsuba computes a wrong density for a lamp of this kind (Mitsuba's issue 1952).
    """
    return next(filter(is_bent, (shape for shape in scene.shapes() if shape.is_emitter())), None)


def _is_tiny(emitter: mi.Emitter, whole: float) -> bool:
    if _SUN in emitter.class_name():
        return True
    if (many := table_of(emitter)) is not None:
        return many.smallest < _TINY * whole
    shape = emitter.get_shape() if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) else None
    return shape is not None and float(np.linalg.norm(np.array(shape.bbox().extents()))) < _TINY * whole


def is_bent(shape: mi.Shape) -> bool:
    """Whether a shape is a mesh whose vertex normals differ from its face normals."""
    # A rectangle is a mesh too, but has no table of faces.
    if not shape.is_mesh() or not shape.has_vertex_normals() or shape.class_name() == "Rectangle":
        return False
    params = mi.traverse(shape)
    faces = np.array(params["faces"]).reshape(-1, 3)
    p, n = (np.array(params[f"vertex_{name}"], np.float64).reshape(-1, 3)[faces] for name in ("positions", "normals"))
    across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(across, axis=-1)
    cosines = np.einsum("fi,fvi->fv", across / np.maximum(area, 1e-30)[:, None], n).mean(axis=-1)
    return bool(area.sum() > 0 and (np.abs(cosines) * area).sum() < _BENT * area.sum())


def _is_sharp(bsdf: mi.BSDF | None) -> bool:
    """Whether a material is a mirror or clear glass, or contains one."""
    return bsdf is not None and (bsdf.class_name() in _SHARP or any(map(_is_sharp, objects_in(bsdf, mi.BSDF))))
