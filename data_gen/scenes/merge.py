"""Fewer shapes of a scene file: equal materials are one, and so are meshes of one material.

Each shape is a case of its own in the kernels, which Dr.Jit records before the first ray. A room of 800 meshes takes
seconds for that, a tenth of it once meshes of one material are one. Shapes keep the order of the file, a merged one has
the place of the first, and all of them lose their names. Meshes that bound a medium stay as they are, and those that
shine as well, unless they are many: see ``many_lamps``.
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
# Instances of a group become meshes if their files have at most this number of bytes in all: copies take memory, unlike
# instances
_MOST_BYTES = 1 << 24


def merge(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> None:
    """Changes the nodes of a scene file that is parsed; files of meshes are looked for as Mitsuba does."""
    # Exporters repeat a material in each shape. Equal ones become the first of them.
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
        # The list of nodes may have moved.
        scene = state.root.props
        scene[names[0]] = merged
        for name in names[1:]:
            del scene[name]


def _copy_instances(state: mi.parser.ParserState) -> None:
    """Puts meshes in the place of instances of groups that are small and have nothing else."""
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
    """Puts copies of ``meshes`` in the place of the instance of that name."""
    instance = state.nodes[state.root.props[name].index()].props
    # Now, for nodes that are added move the others.
    placed = [instance["to_world"]] if "to_world" in instance else []
    for i, number in enumerate(meshes):
        props = mi.Properties(state.nodes[number].props)
        if placed:
            props["to_world"] = placed[0] @ props["to_world"] if "to_world" in props else placed[0]
        copy = added(state, mi.ObjectType.Shape, props)
        state.root.props[f"{name}_{i}" if i else name] = copy


def _bytes_of(mesh: mi.Properties) -> int:
    """The bytes of its file; of a mesh without a file, about what it takes in memory."""
    file = Path(str(mi.file_resolver().resolve(mesh["filename"]))) if "filename" in mesh else None
    return file.stat().st_size if file is not None and file.is_file() else 1 << 10


def _in_pairs(state: mi.parser.ParserState, meshes: list) -> mi.Properties.ResolvedReference:
    """One mesh of all: each is copied as often as they can be halved, and not once for each that is added."""
    if len(meshes) == 1:
        return meshes[0]
    props, middle = mi.Properties("merge"), len(meshes) // 2
    for i, half in enumerate((meshes[:middle], meshes[middle:])):
        props[f"mesh_{i}"] = _in_pairs(state, half)
    return added(state, mi.ObjectType.Shape, props)


def _like(state: mi.parser.ParserState, number: int) -> tuple | None:
    """What meshes that become one have in common; None for a node that stays as it is."""
    props = state.nodes[number].props
    parts = [part for _, part in parts_of(props)]
    if props.plugin_name() not in MESHES or len(parts) != 1 or state.nodes[parts[0]].type != mi.ObjectType.BSDF:
        return None
    return (*parts, *(bool(props.get(name, False)) for name in _NORMALS))
