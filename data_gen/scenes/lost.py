"""Light that a sampler cannot find, or not rightly: said in one line before a render."""

from __future__ import annotations

import logging

import mitsuba as mi
import numpy as np

from data_gen.samplers.registry import FRAME_SAMPLERS, SAMPLERS, choose
from data_gen.scenes.facts import scene_facts, shapes_of
from data_gen.scenes.integrators import objects_in

_LOG = logging.getLogger(f"ngpt.{__name__}")

_SHARP = ("SmoothConductor", "SmoothDielectric")
# Lamps smaller than this share of the scene's diagonal are met by hardly any path.
_TINY = 1 / 500
# By the part of its class's name that all kinds of it have: the disk of a sun fills 7e-5 of a hemisphere.
_SUN = "Sunsky"
# Vertex normals are far from those of faces below this mean cosine, of 14 degrees.
_BENT = 0.97


def warn_of_lost_light(scene: mi.Scene, sampler: str) -> None:
    """Says which light of the scene the sampler does not find, and which one does."""
    facts = scene_facts(scene)
    if facts.integrator not in ("path", "volpath", "volpathmis"):
        return
    sampler = choose(facts)[0] if sampler == "auto" else sampler
    entry = FRAME_SAMPLERS.get(sampler) or SAMPLERS[sampler]
    if not getattr(entry, "finds", ()) and (reason := sharp_lights(scene)):
        able = [name for name, entry in SAMPLERS.items() if _finds_all(entry) and not entry.refuses(facts)]
        remedy = f"--sampler {able[0]} finds it" if able else "no sampler that renders this scene finds it"
        _LOG.warning("%s: '%s' does not find most of what these make of their light; %s", reason, sampler, remedy)
    if facts.integrator == "path" and (lost := entry.loses) and without_size(scene) and holes(scene):
        _LOG.warning("of lamps without size, '%s' loses light %s; --sampler gpt, or primal, finds it", sampler, lost)
    if bent := next(filter(_is_bent, scene.emitters()), None):
        _LOG.warning(
            "lamp%s has few faces and smooth normals, which Mitsuba %s samples by one normal and weighs by another: "
            "light beside it is wrong by up to 4 %%; give the lamp face_normals=true",
            f" '{name}'" if (name := bent.get_shape().id()) else "",
            mi.__version__,
        )


def _finds_all(entry) -> bool:
    return "caustics" in entry.finds and "hidden lamps" in entry.finds and entry.standing == "use"


def sharp_lights(scene: mi.Scene) -> str:
    """Which lamps hardly a path from the camera meets behind the scene's glass or mirrors; "" if there are none."""
    if not any(_is_sharp(shape.bsdf()) for shape in shapes_of(scene)):
        return ""
    if without_size(scene):
        return "lamps without size meet smooth glass or mirrors"
    return "tiny lamps meet smooth glass or mirrors" if any(map(_is_tiny, _lamps(scene))) else ""


def without_size(scene: mi.Scene) -> bool:
    return any(mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) for emitter in scene.emitters())


def holes(scene: mi.Scene) -> bool:
    """Whether light goes straight through something, media apart."""
    bsdfs = (shape.bsdf() for shape in shapes_of(scene) if not shape.is_medium_transition())
    return any(bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)


def _lamps(scene: mi.Scene) -> list[tuple[mi.Emitter, float]]:
    """All emitters, and the size of each over the scene's; 1 of what is infinitely far away."""
    whole, found = float(np.linalg.norm(np.array(scene.bbox().extents()))), []
    for emitter in scene.emitters():
        on_shape = mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
        box = emitter.get_shape().bbox() if on_shape else None
        found.append((emitter, float(np.linalg.norm(np.array(box.extents()))) / whole if box else 1.0))
    return found


def _is_tiny(lamp: tuple[mi.Emitter, float]) -> bool:
    emitter, size = lamp
    return size < _TINY or _SUN in emitter.class_name()


def _is_bent(emitter: mi.Emitter) -> bool:
    """Whether it is a mesh with vertex normals that are far from those of its faces."""
    shape = emitter.get_shape() if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) else None
    if shape is None or not shape.is_mesh() or not shape.has_vertex_normals():
        return False
    params = mi.traverse(shape)
    faces = np.array(params["faces"]).reshape(-1, 3)
    p, n = (np.array(params[f"vertex_{name}"], np.float64).reshape(-1, 3)[faces] for name in ("positions", "normals"))
    across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.linalg.norm(across, axis=-1)
    cosines = np.einsum("fi,fvi->fv", across / np.maximum(area, 1e-30)[:, None], n).mean(axis=-1)
    return bool(area.sum() > 0 and (np.abs(cosines) * area).sum() < _BENT * area.sum())


def _is_sharp(bsdf: mi.BSDF | None) -> bool:
    """Whether it is a mirror or clear glass, or one within it."""
    return bsdf is not None and (bsdf.class_name() in _SHARP or any(map(_is_sharp, objects_in(bsdf, mi.BSDF))))
