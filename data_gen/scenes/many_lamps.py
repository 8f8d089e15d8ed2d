"""Merges lamps: hundreds of small shining meshes become 64 meshes, each with one emitter for all of its lamps.

Before the first sample, Dr.Jit records every virtual call of a kernel for each shape and each emitter of a scene. With
2,000 lamps this takes seconds. Lamps that are close together share a mesh, so samplers can still choose lamps by place.
Within a mesh, points are sampled in proportion to the radiance.

A lamp keeps its radiance and its material. It loses its name and its texture coordinates: u now holds the number of the
lamp in its mesh, and this number is used to look up the radiance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import mitsuba as mi
import numpy as np

from data_gen.scenes.lamp_mesh import LampFaces, lamps, mesh_of
from data_gen.scenes.lost import is_bent
from data_gen.scenes.nodes import MESHES, added, is_part, parts_of

# Lamps of one material are merged if they are at least this many
MANY = 256
# How often the lamps of a material are split into halves; 6 times gives 64 meshes
_HALVINGS = 6
# The corners of Mitsuba's rectangle, and its faces
_RECTANGLE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
_FACES = np.array([[0, 1, 2], [2, 3, 0]])
_PLUGIN = "ngpt_lamps"


@dataclass
class Lamp:
    """A mesh that shines: the ``corners`` (F, 3, 3) of its faces, counterclockwise as seen from the side that shines,
    and the ``radiance`` (3,)."""

    corners: np.ndarray
    radiance: np.ndarray


def merge_lamps(state: mi.parser.ParserState) -> None:
    """Merges the lamps in the nodes of a parsed scene file. In spectral and polarised variants it changes nothing."""
    if not mi.is_rgb or mi.is_polarized:
        return
    groups: dict[int | None, dict[str, tuple[int, np.ndarray]]] = {}
    for name, material, shape, radiance in _candidates(state):
        groups.setdefault(material, {})[name] = shape, radiance
    for material, found in groups.items():
        if len(found) < MANY:
            continue
        each = {name: _lamp(state.nodes[shape].props, radiance) for name, (shape, radiance) in found.items()}
        known = {name: lamp for name, lamp in each.items() if lamp}
        if len(known) >= MANY:
            _merge(state, material, known)


def _merge(state: mi.parser.ParserState, material: int | None, known: dict[str, Lamp]) -> None:
    """Replaces the lamps of one material by meshes. Each mesh takes the place of its first lamp."""
    _register(mi.variant())
    names = list(known)
    middles = np.array([lamp.corners.reshape(-1, 3).mean(axis=0) for lamp in known.values()])
    for part in _halved(np.arange(len(names)), middles, _HALVINGS):
        props = mi.Properties(_PLUGIN)
        props["emitter"] = lamps(_table([known[names[i]] for i in part]))
        if material is not None:
            props["bsdf"] = mi.Properties.ResolvedReference(material)
        state.root.props[names[part[0]]] = added(state, mi.ObjectType.Shape, props)
        for i in part[1:]:
            del state.root.props[names[i]]


@cache
def _register(variant: str) -> None:
    """Registers the plugin with a variant, which must be the current one."""
    mi.register_shape(_PLUGIN, mesh_of)


def _candidates(state: mi.parser.ParserState) -> Iterator[tuple[str, int | None, int, np.ndarray]]:
    """Yields name, material node (None: Mitsuba's default), mesh node and radiance of each mesh with one radiance."""
    for name, number in parts_of(state.root.props):
        shape = state.nodes[number].props
        nodes = [part for _, part in parts_of(shape)]
        lamp = [part for part in nodes if state.nodes[part].type == mi.ObjectType.Emitter]
        material = [part for part in nodes if state.nodes[part].type == mi.ObjectType.BSDF]
        if shape.plugin_name() not in MESHES or len(lamp) != 1 or len(material) > 1 or len(nodes) > 1 + len(material):
            continue
        radiance = _radiance(state.nodes[lamp[0]].props)
        if radiance is not None and not any(_has_texture(state, each) for each in material):
            yield name, material[0] if material else None, number, radiance


def _radiance(lamp: mi.Properties) -> np.ndarray | None:
    """The radiance of an area emitter with one colour and no other settings; None for all others."""
    if lamp.plugin_name() != "area" or [name for name, _ in lamp.items()] != ["radiance"]:
        return None
    value = lamp["radiance"]
    return np.array(value, float) if isinstance(value, mi.ScalarColor3d) else None


def _has_texture(state: mi.parser.ParserState, number: int) -> bool:
    node = state.nodes[number]
    return node.type == mi.ObjectType.Texture or any(_has_texture(state, part) for _, part in parts_of(node.props))


def _lamp(shape: mi.Properties, radiance: np.ndarray) -> Lamp | None:
    """The lamp of a mesh's node; None if its vertex normals differ from its face normals."""
    flipped = bool(shape.get("flip_normals", False))
    normals = None
    if shape.plugin_name() == "rectangle":
        # A rectangle has no table of faces.
        to_world = np.array(shape["to_world"].matrix, float) if "to_world" in shape else np.eye(4)
        corners = (_RECTANGLE @ to_world[:3, :3].T + to_world[:3, 3])[_FACES]
        # In Mitsuba the normal is transformed, too, so a reflection flips the order of the corners.
        flipped ^= bool(np.linalg.det(to_world[:3, :3]) < 0)
    else:
        settings = {name: value for name, value in shape.items() if not is_part(value)}
        mesh = mi.load_dict({"type": shape.plugin_name(), **settings})
        if is_bent(mesh):
            return None
        params = mi.traverse(mesh)
        faces = np.array(params["faces"]).reshape(-1, 3)
        corners = np.array(params["vertex_positions"], float).reshape(-1, 3)[faces]
        if mesh.has_vertex_normals():
            normals = np.array(params["vertex_normals"], float).reshape(-1, 3)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if normals is not None:
        corners = np.where((across[:, None] * normals).sum(axis=(1, 2))[:, None, None] < 0, corners[:, ::-1], corners)
    faces = (corners[:, ::-1] if flipped else corners)[np.linalg.norm(across, axis=1) > 0]
    return Lamp(faces, radiance) if len(faces) else None


def _halved(part: np.ndarray, middles: np.ndarray, times: int) -> Iterator[np.ndarray]:
    """Splits ``part`` (numbers of lamps) into groups of lamps that are close together.

    Within each group, the lamps have the order of the file.
    """
    if times == 0 or len(part) < 2:
        yield np.sort(part)
        return
    axis = int(np.argmax(np.ptp(middles[part], axis=0)))
    part = part[np.argsort(middles[part, axis], kind="stable")]
    for half in np.array_split(part, 2):
        yield from _halved(half, middles, times - 1)


def _table(each: list[Lamp]) -> LampFaces:
    numbers = np.repeat(np.arange(len(each)), [len(lamp.corners) for lamp in each])
    corners = np.concatenate([lamp.corners for lamp in each])
    return LampFaces(corners, numbers, np.array([lamp.radiance for lamp in each]))
