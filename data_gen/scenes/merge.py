"""Merges equal materials of a scene file, and meshes that share a material.

Dr.Jit records each shape as a separate case of its kernels before the first ray. This takes seconds for a room of 800
meshes, and a tenth of that time if meshes of one material are merged. Shapes keep the order of the file. A merged mesh
takes the place of the first of its meshes, and the names of all its meshes are lost. Meshes that bound a medium are not
merged. Meshes that shine are merged only if they are many: see ``many_lamps``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi

from data_gen.scenes.many_lamps import merge_lamps
from data_gen.scenes.nodes import MESHES, added, parts_of

# Settings of meshes that change normals
_NORMALS = ("face_normals", "flip_normals")
# The instances of a group are replaced by copies of its meshes if all copies together have at most this many bytes.
# Unlike instances, copies take memory
_MOST_BYTES = 1 << 24


def merge(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> None:
    """Merges the nodes of a parsed scene file. Mitsuba's file resolver finds the files of meshes."""
    # Exporters repeat a material in each shape. Equal materials are replaced by the first of them.
    mi.parser.transform_merge_equivalent(config, state)
    merge_lamps(state)
    _copy_instances(state)
    scene = state.root.props
    groups: dict[Any, list[str]] = {}
    for name, number in parts_of(scene):
        if key := _like(state, number):
            groups.setdefault(key, []).append(name)
    for names in groups.values():
        merged = _in_pairs(state, [scene[name] for name in names])
        # The root is read again, since the list of nodes may have moved in memory
        scene = state.root.props
        scene[names[0]] = merged
        for name in names[1:]:
            del scene[name]


def _copy_instances(state: mi.parser.ParserState) -> None:
    """Replaces instances by meshes, if their groups are small and contain only meshes."""
    instances: dict[int, list[str]] = {}
    for name, number in parts_of(state.root.props):
        if state.nodes[number].props.plugin_name() == "instance":
            for _, group in parts_of(state.nodes[number].props):
                instances.setdefault(group, []).append(name)
    for group, names in instances.items():
        meshes = [number for _, number in parts_of(state.nodes[group].props)]
        if not all(_like(state, number) for number in meshes):
            continue
        if len(names) * sum(_bytes_of(state.nodes[number].props) for number in meshes) > _MOST_BYTES:
            continue
        for name in names:
            _copy(state, name, meshes)
        for name, number in list(parts_of(state.root.props)):
            if number == group:
                del state.root.props[name]


def _copy(state: mi.parser.ParserState, name: str, meshes: Sequence[int]) -> None:
    """Replaces the instance called ``name`` by copies of ``meshes``."""
    instance = state.nodes[state.root.props[name].index()].props
    # This is read before nodes are added, since adding a node may move the other nodes in memory
    placed = [instance["to_world"]] if "to_world" in instance else []
    for i, number in enumerate(meshes):
        props = mi.Properties(state.nodes[number].props)
        if placed:
            props["to_world"] = placed[0] @ props["to_world"] if "to_world" in props else placed[0]
        copy = added(state, mi.ObjectType.Shape, props)
        state.root.props[f"{name}_{i}" if i else name] = copy


def _bytes_of(mesh: mi.Properties) -> int:
    """The size of a mesh's file in bytes. For a mesh without a file, a rough size in memory."""
    file = Path(str(mi.file_resolver().resolve(mesh["filename"]))) if "filename" in mesh else None
    return file.stat().st_size if file is not None and file.is_file() else 1 << 10


def _in_pairs(state: mi.parser.ParserState, meshes: list) -> mi.Properties.ResolvedReference:
    """Merges n meshes in pairs, so that each mesh is copied log2(n) times.

    If meshes were added one by one, the first mesh would be copied n times.
    """
    if len(meshes) == 1:
        return meshes[0]
    props, middle = mi.Properties("merge"), len(meshes) // 2
    for i, half in enumerate((meshes[:middle], meshes[middle:])):
        props[f"mesh_{i}"] = _in_pairs(state, half)
    return added(state, mi.ObjectType.Shape, props)


def _like(state: mi.parser.ParserState, number: int) -> tuple | None:
    """A key that is equal for meshes that can be merged; None for a node that must stay as it is."""
    props = state.nodes[number].props
    parts = [part for _, part in parts_of(props)]
    if props.plugin_name() not in MESHES or len(parts) != 1 or state.nodes[parts[0]].type != mi.ObjectType.BSDF:
        return None
    return (*parts, *(bool(props.get(name, False)) for name in _NORMALS))
