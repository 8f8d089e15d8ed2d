"""Scene files, whose meshes are merged by material and of whose sensors one may be chosen.

Each shape of a scene is a case of its own in the kernels, which Dr.Jit records before the first ray. A room of 800
meshes takes seconds for that, and a tenth of it once meshes of one material are one.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from data_gen.scenes.cameras import sensor_number

# The plugins that read meshes, and their settings that change normals
_MESHES = ("obj", "ply", "serialized")
_NORMALS = ("face_normals", "flip_normals")


def load_file(path: str, parameters: dict[str, str], merged: bool, sensor: int | str | None) -> object:
    """What ``mi.load_file`` gives, with no sensor but the one of that number or id, where one is named.

    Where ``merged``, meshes of one material that neither shine nor bound a medium are one, and lose their names. Merged
    as Mitsuba would (``optimize=True``), shapes and emitters come in another order each time, and with them other bits;
    here they have the file's order, each group the place of its first mesh.
    """
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    # In parallel objects are numbered as they come, which differs from process to process, and with it the kernel: it
    # would be compiled again.
    config.parallel = False
    with _found_beside(path):
        state = mi.parser.parse_file(config, path, **parameters)
        mi.parser.transform_all(config, state)
        if state.root.props.plugin_name() == "scene":
            if merged:
                _merge(state)
            if sensor is not None:
                _keep(state, sensor, path)
        return mi.parser.instantiate(config, state)


def _merge(state: mi.parser.ParserState) -> None:
    scene = state.root.props
    groups: dict[Any, list[str]] = {}
    for name, reference in scene.items():
        if isinstance(reference, mi.Properties.ResolvedReference) and (key := _group(state, reference.index())):
            groups.setdefault(key, []).append(name)
    for names in groups.values():
        if len(names) == 1:
            continue
        node = mi.parser.SceneNode()
        node.type, node.props = mi.ObjectType.Shape, mi.Properties("merge")
        for i, name in enumerate(names):
            node.props[f"mesh_{i}"] = scene[name]
        state.nodes.append(node)
        # The list may have moved.
        scene = state.root.props
        scene[names[0]] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
        for name in names[1:]:
            del scene[name]


def _keep(state: mi.parser.ParserState, sensor: int | str, path: str) -> None:
    """Leaves out all sensors of the scene but that one. Raises WrongUse where it is not there."""
    scene, found = state.root.props, {}
    for name, reference in scene.items():
        if isinstance(reference, mi.Properties.ResolvedReference):
            node = state.nodes[reference.index()]
            if node.type == mi.ObjectType.Sensor:
                found[name] = node.props.id()
    if found:
        kept = sensor_number(sensor, list(found.values()), path)
        for number, name in enumerate(found):
            if number != kept:
                del scene[name]


def _group(state: mi.parser.ParserState, number: int) -> tuple | None:
    """What meshes that become one have in common; None for a node that stays as it is."""
    props = state.nodes[number].props
    parts = [part.index() for _, part in props.items() if isinstance(part, mi.Properties.ResolvedReference)]
    if props.plugin_name() not in _MESHES or len(parts) != 1 or state.nodes[parts[0]].type != mi.ObjectType.BSDF:
        return None
    return (*parts, *(bool(props.get(name, False)) for name in _NORMALS))


@contextmanager
def _found_beside(path: str):
    """While in it, files that a scene names are looked for beside it first."""
    resolver = mi.file_resolver()
    before = list(resolver)
    resolver.prepend(str(Path(path).resolve().parent))
    try:
        yield
    finally:
        resolver.clear()
        for folder in before:
            resolver.append(folder)
