"""Animated cameras of glTF 2.0 files (.gltf, .glb), as Blender and others export them. Pure NumPy."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from data_gen.frames.camera_path import CameraPath, Key
from ngpt.errors import NgptError, WrongUse
from ngpt.system.reading import read_bytes
from ngpt.system.records import check

# A glTF camera looks along its -z, with +x to the right. Mitsuba's cameras look along their +z, with +x to the left.
_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])
_DEFAULTS = {"translation": [0.0, 0, 0], "rotation": [0.0, 0, 0, 1], "scale": [1.0, 1, 1]}
# The largest number of frames, more than anyone animates. The limit keeps a broken file from filling the memory.
_MOST = 1_000_000
_MOST_BYTES = 2**30  # of a file or a buffer beside it

# A property of a node: times (K,), values (K, C) or (3K, C), and how to interpolate
Channel = tuple[np.ndarray, np.ndarray, str]


def read_gltf_camera(path: str | Path, fps: float) -> CameraPath:
    """The path of a file's first camera, a key for each frame; frame 0 is second 0.

    Coordinates are as in the file, where +y is up. Buffers may be in the file, in its folder or in folders below.
    Raises NgptError for files that cannot be read, and where no node has a perspective camera.
    """
    if not 0 < fps < math.inf:
        raise WrongUse(f"{path}: {fps:g} frames a second; give a positive number")
    try:
        content, binary = _load(Path(path))
        return _path(Path(path), content, binary, fps)
    except NgptError:
        raise
    # Missing entries and wrong types raise errors where they are used.
    except (LookupError, AttributeError, TypeError, ValueError, ArithmeticError, RecursionError, struct.error) as error:
        raise NgptError(f"{path}: is no glTF 2.0 file that can be understood: {error!r}") from error


def _load(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON of a file, and the buffer that a .glb brings with it."""
    data = read_bytes(path, _MOST_BYTES)
    if data[:4] != b"glTF":
        return json.loads(data), b""
    chunks, place = [b"", b""], 12
    for number in range(2):
        if place + 8 > len(data):
            break
        length = struct.unpack_from("<I", data, place)[0]
        chunks[number] = data[place + 8 : place + 8 + length]
        place += 8 + length
    return json.loads(chunks[0]), chunks[1]


def _path(path: Path, content: dict[str, Any], binary: bytes, fps: float) -> CameraPath:
    check(content, dict, f"{path}: what it holds")
    nodes = content.get("nodes", [])
    found = [i for i, node in enumerate(nodes) if "camera" in node]
    if not found:
        raise NgptError(f"{path}: has no camera; export it with the cameras")
    camera = content["cameras"][nodes[found[0]]["camera"]]
    if camera["type"] != "perspective":
        raise NgptError(f"{path}: its first camera is {camera['type']}; it must be perspective")
    parents = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
    chain = [found[0]]
    while chain[-1] in parents and len(chain) <= len(nodes):
        chain.append(parents[chain[-1]])
    channels = _channels(path, content, binary, chain)
    times = np.concatenate([times for times, _, _ in channels.values()]) if channels else np.zeros(1)
    first, last = math.floor(times.min() * fps + 1e-3), math.ceil(times.max() * fps - 1e-3)
    if last - first > _MOST:
        raise NgptError(f"{path}: its camera moves for {last - first} frames, more than {_MOST}")
    fov = math.degrees(camera["perspective"]["yfov"])
    if not 0 < fov < 180:
        raise NgptError(f"{path}: yfov of its first camera is {fov:g} degrees; it must be between 0 and 180")
    keys = []
    for frame in range(first, max(first, last) + 1):
        matrix = np.eye(4)
        for number in chain:
            matrix = _local(nodes[number], number, channels, frame / fps) @ matrix
        keys.append(Key(frame, matrix @ _TURN, None, fov, "y"))
    return CameraPath(keys, path)


def _channels(path: Path, content: dict[str, Any], binary: bytes, chain: list[int]) -> dict[tuple[int, str], Channel]:
    """The channels of all animated properties of the nodes in ``chain``: (node, property) -> channel.

    If several animations change a property, the first one counts.
    """
    channels: dict[tuple[int, str], Channel] = {}
    for animation in content.get("animations", []):
        for channel in animation["channels"]:
            where = (channel["target"].get("node"), channel["target"]["path"])
            if where[0] in chain and where[1] in _DEFAULTS and where not in channels:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = (_accessor(path, content, binary, sampler[end]) for end in ("input", "output"))
                if not (np.diff(times[:, 0]) > 0).all():
                    raise NgptError(f"{path}: times of an animation do not rise; export it anew")
                channels[where] = (times[:, 0], values, sampler.get("interpolation", "LINEAR"))
    return channels


def _accessor(path: Path, content: dict[str, Any], binary: bytes, number: int) -> np.ndarray:
    """The numbers of an accessor, (count, components) double precision."""
    accessor = content["accessors"][number]
    if accessor["componentType"] != 5126 or "sparse" in accessor:
        raise NgptError(f"{path}: animations of integers or sparse ones are not known; export them as floats")
    components = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    view = content["bufferViews"][accessor["bufferView"]]
    uri = content["buffers"][view["buffer"]].get("uri")
    if uri is None:
        data = binary
    elif uri.startswith("data:"):
        data = base64.b64decode(uri.partition(",")[2])
    else:
        data = read_bytes(_beside(path, uri), _MOST_BYTES)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    count = accessor["count"]
    if view.get("byteStride", 4 * components) != 4 * components or count < 1:
        raise NgptError(f"{path}: accessor {number} is interleaved or empty")
    numbers = np.frombuffer(data, "<f4", count * components, start).reshape(count, components).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise NgptError(f"{path}: accessor {number} has numbers that are not finite; export it anew")
    return numbers


def _beside(path: Path, uri: str) -> Path:
    """The file of a relative URI; raises NgptError for one that leads elsewhere than below the folder of ``path``."""
    name = unquote(uri)
    place = PurePosixPath(name)
    if place.is_absolute() or ".." in place.parts or "\\" in name or ":" in place.parts[0]:
        raise NgptError(
            f"{path}: its buffer '{name[:200]}' is not in its folder or below; pack it into a .glb, or embed it"
        )
    return path.parent / place


def _local(node: dict[str, Any], number: int, channels: dict[tuple[int, str], Channel], time: float) -> np.ndarray:
    """The matrix (4, 4) from the space of a node to that of its parent."""
    moves = [name for name in _DEFAULTS if (number, name) in channels]
    if "matrix" in node and not moves:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    now = {name: np.asarray(node.get(name, default), np.float64) for name, default in _DEFAULTS.items()}
    now |= {name: _at(channels[number, name], name, time) for name in moves}
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(now["rotation"]).as_matrix() * now["scale"]
    matrix[:3, 3] = now["translation"]
    return matrix


def _at(channel: Channel, name: str, time: float) -> np.ndarray:
    """The value of a channel at a time (glTF 2.0 specification, appendix C)."""
    times, values, way = channel
    cubic = way == "CUBICSPLINE"
    keys = values[1::3] if cubic else values
    after = int(np.searchsorted(times, time, side="right"))
    if after == 0 or after == len(times):
        return keys[min(after, len(times) - 1)]
    one, other = after - 1, after
    step = times[other] - times[one]
    t = (time - times[one]) / step
    if way == "STEP":
        return keys[one]
    if cubic:
        out, into = values[3 * one + 2] * step, values[3 * other] * step
        return (
            (2 * t**3 - 3 * t**2 + 1) * keys[one]
            + (t**3 - 2 * t**2 + t) * out
            + (3 * t**2 - 2 * t**3) * keys[other]
            + (t**3 - t**2) * into
        )
    if name == "rotation":
        return Slerp([0, 1], Rotation.from_quat(keys[[one, other]]))(t).as_quat()
    return (1 - t) * keys[one] + t * keys[other]
