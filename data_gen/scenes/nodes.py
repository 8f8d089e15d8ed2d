"""Nodes of a scene file that is parsed but not instantiated yet."""

from __future__ import annotations

import mitsuba as mi

# The plugins of meshes
MESHES = ("obj", "ply", "serialized", "cube", "rectangle")


def parts_of(props: mi.Properties) -> list[tuple[str, int]]:
    """(name, number) of each node that a node refers to."""
    return [(name, part.index()) for name, part in props.items() if is_part(part)]


def is_part(value: object) -> bool:
    return isinstance(value, mi.Properties.ResolvedReference)


def added(state: mi.parser.ParserState, kind: mi.ObjectType, props: mi.Properties) -> mi.Properties.ResolvedReference:
    """Adds a node and returns a reference to it. The list of nodes, with all their properties, may move in memory."""
    node = mi.parser.SceneNode()
    node.type, node.props = kind, props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)
