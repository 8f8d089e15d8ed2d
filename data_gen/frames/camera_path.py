"""Camera paths: key frames in a JSON file, and the interpolation between them. Pure NumPy."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ngpt.errors import NgptError
from ngpt.system.records import read_json

_LOOK = ("origin", "target", "up")
_KNOWN = {"frame", "to_world", *_LOOK, "fov", "fov_axis"}


@dataclass(frozen=True)
class Key:
    frame: float
    to_world: np.ndarray  # (4, 4), as in Mitsuba: columns left, up, forward, position; a ``CameraPath`` has no scale
    look: np.ndarray | None = None  # (3, 3), rows origin, target and up; None if the key has only a matrix
    fov: float | None = None  # degrees; None: the scene's own
    fov_axis: str = "x"  # the axis of ``fov``: "x" (width) or "y" (height)


class CameraPath:
    """Key frames in rising order. Before the first and after the last one the camera rests.

    A camera's scale, which exporters write and Mitsuba refuses, is taken out of its matrix. Raises NgptError for a
    matrix that flattens space or is not finite, and for cameras that are mirrored in some keys and not in others. The
    error's message begins with the name of the ``file``, if given.
    """

    def __init__(self, keys: list[Key], file: str | Path = ""):
        where = f"{file}: " if file else ""
        self.keys = [replace(key, to_world=_rigid(key, where)) for key in keys]
        for one, other in pairwise(self.keys):
            if _mirrored(one.to_world) != _mirrored(other.to_world):
                frames = f"frames {one.frame:g} and {other.frame:g}"
                raise NgptError(
                    f"{where}the camera is mirrored in one of the {frames} and not in the other, and nothing is "
                    "between them; give both the same sign of scale"
                )

    def at(self, frame: float) -> Key:
        """The camera at a frame.

        If both neighbouring keys have a target, then origin, target, up and fov are interpolated linearly. Otherwise
        position and fov are interpolated linearly, and the orientation turns evenly about one axis.
        """
        after = bisect_right([key.frame for key in self.keys], frame)
        if after == 0 or after == len(self.keys):
            return self.keys[min(after, len(self.keys) - 1)]
        one, other = self.keys[after - 1], self.keys[after]
        t = (frame - one.frame) / (other.frame - one.frame)
        fov = one.fov if one.fov is None or other.fov is None else one.fov + t * (other.fov - one.fov)
        if one.look is not None and other.look is not None:
            look = one.look + t * (other.look - one.look)
            return Key(frame, look_at(*look), look, fov, one.fov_axis)
        return Key(frame, _between(one.to_world, other.to_world, t), None, fov, one.fov_axis)


def look_at(origin, target, up) -> np.ndarray:
    """The (4, 4) matrix of a Mitsuba camera at ``origin`` that looks at ``target``; ValueError if there is none.

    A camera looks along its +z, with +x to the left of the image.
    """
    origin, target, up = (np.asarray(v, np.float64) for v in (origin, target, up))
    forward = target - origin
    left = np.cross(up, forward)
    lengths = np.linalg.norm(forward), np.linalg.norm(left)
    if not min(lengths) > 0:
        raise ValueError("the camera is at its target, or looks along its up direction")
    forward, left = forward / lengths[0], left / lengths[1]
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    return matrix


def _rigid(key: Key, where: str) -> np.ndarray:
    """The matrix of a key without its scale. The direction of view, the side that is up and the reflection stay the
    same."""
    matrix = np.asarray(key.to_world, np.float64)
    # Numbers of the renderer are single precision.
    with np.errstate(over="ignore"):
        if not np.isfinite(matrix.astype(np.float32)).all():
            what = "the camera's matrix has numbers that are not finite, or beyond 1e38"
            raise NgptError(f"{where}frame {key.frame:g}: {what}")
    axes = matrix[:3, :3]
    if np.allclose(axes.T @ axes, np.eye(3), atol=1e-6):
        return matrix
    lengths = np.linalg.norm(axes, axis=0)
    volume = np.linalg.det(axes / lengths) if lengths.min() > 0 else 0.0
    if not abs(volume) > 1e-6:
        raise NgptError(f"{where}frame {key.frame:g}: the camera's matrix flattens space (a scale of 0?)")
    forward = axes[:, 2] / lengths[2]
    up = axes[:, 1] / lengths[1]
    up = up - (up @ forward) * forward
    up /= np.linalg.norm(up)
    rigid = matrix.copy()
    rigid[:3, :3] = np.stack([np.sign(volume) * np.cross(up, forward), up, forward], axis=1)
    return rigid


def _mirrored(matrix: np.ndarray) -> bool:
    return bool(np.linalg.det(matrix[:3, :3]) < 0)


def _between(one: np.ndarray, other: np.ndarray, t: float) -> np.ndarray:
    # Mirrored cameras are mirrored back, since only rotations can be interpolated.
    side = np.array([-1.0 if _mirrored(one) else 1.0, 1, 1])
    turns = Rotation.from_matrix([m[:3, :3] * side for m in (one, other)])
    matrix = np.eye(4)
    matrix[:3, :3] = Slerp([0, 1], turns)(t).as_matrix() * side
    matrix[:3, 3] = (1 - t) * one[:3, 3] + t * other[:3, 3]
    return matrix


def read_camera_path(path: str | Path) -> CameraPath:
    """Reads ``{"keys": [{"frame": 0, ...}, ...]}``, or only the list.

    A key has ``to_world`` (4 rows of 4 numbers, Mitsuba's) or ``origin``, ``target`` and, if not +y, ``up``; and may
    have ``fov`` in degrees with ``fov_axis`` "x" (default) or "y". Raises NgptError for other files and keys.
    """
    content = read_json(path)
    entries = content.get("keys") if isinstance(content, dict) else content
    if not isinstance(entries, list) or not entries:
        raise NgptError(f'{path}: holds no camera keys; write {{"keys": [{{"frame": 0, "origin": ...}}, ...]}}')
    keys = [_key(entry, number, f"{path}: key {number}") for number, entry in enumerate(entries)]
    for one, other in pairwise(keys):
        if not one.frame < other.frame:
            raise NgptError(f"{path}: frame {other.frame:g} comes after frame {one.frame:g}; sort keys by frame")
        if (one.fov is None) != (other.fov is None) or one.fov_axis != other.fov_axis:
            raise NgptError(f"{path}: frames {one.frame:g} and {other.frame:g} differ in fov_axis, or one has no fov")
    return CameraPath(keys, path)


def _key(entry: Any, number: int, where: str) -> Key:
    if not isinstance(entry, dict):
        raise NgptError(f"{where} is {entry!r}; it must be an object with frame, and to_world or origin and target")
    if strange := entry.keys() - _KNOWN:
        raise NgptError(f"{where} has '{min(strange)}'; known are {', '.join(sorted(_KNOWN))}")
    frame = float(_numbers(entry.get("frame", number), (), f"{where}: frame"))
    fov, axis = entry.get("fov"), entry.get("fov_axis", "x")
    if axis not in ("x", "y"):
        raise NgptError(f'{where}: fov_axis is {axis!r}; it must be "x" (width) or "y" (height)')
    if fov is not None:
        fov = float(_numbers(fov, (), f"{where}: fov"))
        if not 0 < fov < 180:
            raise NgptError(f"{where}: fov is {fov:g}; it must be between 0 and 180 degrees")
    if "to_world" in entry:
        if given := [name for name in _LOOK if name in entry]:
            raise NgptError(f"{where} has both to_world and {given[0]}; leave one out")
        matrix = _numbers(entry["to_world"], (4, 4), f"{where}: to_world")
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise NgptError(f"{where}: the last row of to_world is not 0 0 0 1")
        return Key(frame, matrix, None, fov, axis)
    for name in ("origin", "target"):
        if name not in entry:
            raise NgptError(f"{where} has no {name}; give to_world, or origin and target")
    look = np.stack([_numbers(entry.get(name, [0, 1, 0]), (3,), f"{where}: {name}") for name in _LOOK])
    try:
        return Key(frame, look_at(*look), look, fov, axis)
    except ValueError as error:
        raise NgptError(f"{where}: {error}") from error


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(())
        value = "not numbers"
    if array.shape != shape or isinstance(value, str | bool) or not np.isfinite(array).all():
        size = " x ".join(map(str, shape)) or "1"
        raise NgptError(f"{what} is {value!r}; it must be {size} finite number{'s' if shape else ''}")
    return array


def horizontal(fov: float, axis: str, aspect: float) -> float:
    """Converts a field of view along ``axis`` to one along the width, degrees; ``aspect`` is width over height."""
    if axis == "x":
        return fov
    return 2 * math.degrees(math.atan(aspect * math.tan(math.radians(fov) / 2)))
