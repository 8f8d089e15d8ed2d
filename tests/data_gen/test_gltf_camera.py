"""Cameras of glTF files."""

import base64
import json
import math
import os
import struct
from functools import reduce

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.frames.camera_path import look_at, read_camera_path
from data_gen.frames.gltf import read_gltf_camera
from ngpt.errors import NgptError

TIMES = np.array([0, 1], np.float32)
MOVES = np.array([[0, 1, 4], [2, 1, 4]], np.float32)
TURNS = np.array([[0, 0, 0, 1], Rotation.from_euler("y", 60, degrees=True).as_quat()], np.float32)


def content(buffer, way="LINEAR", moves=MOVES, turns=TURNS, times=TIMES):
    """A camera that moves and turns, in a node that stands one unit higher; and its bytes."""
    parts = [times, np.asarray(moves, np.float32), np.asarray(turns, np.float32)]
    data, views, accessors = b"", [], []
    for part, kind in zip(parts, ("SCALAR", "VEC3", "VEC4"), strict=True):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": part.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": len(part), "type": kind})
        data += part.tobytes()
    channels = [
        {"sampler": i, "target": {"node": 2, "path": path}} for i, path in enumerate(("translation", "rotation"))
    ]
    return {
        "asset": {"version": "2.0"},
        "cameras": [{"type": "perspective", "perspective": {"yfov": np.pi / 4, "znear": 0.1}}],
        "nodes": [{"name": "thing"}, {"translation": [0, 1, 0], "children": [2]}, {"camera": 0}],
        "animations": [
            {"channels": channels, "samplers": [{"input": 0, "output": i, "interpolation": way} for i in (1, 2)]}
        ],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(data)} | ({"uri": buffer(data)} if buffer else {})],
    }, data


def embedded(data):
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


# Times that never end, and times that fall
INFINITE = embedded(np.full(64, np.inf, np.float32).tobytes())
FALLING = embedded(np.array([1, 0], np.float32).tobytes() + content(None)[1][8:])


def stored(folder, way):
    """The camera in a file: with its numbers in the text, in a file beside it, or behind it."""
    if way != "glb":
        scene, data = content(embedded if way == "embedded" else lambda data: "the%20buffer.bin")
        (folder / "the buffer.bin").write_bytes(data)
        (folder / "a.gltf").write_text(json.dumps(scene))
        return folder / "a.gltf"
    scene, data = content(None)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x4E4942) + data
    (folder / "a.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return folder / "a.glb"


@pytest.mark.parametrize("way", ["embedded", "beside", "glb"])
def test_a_camera_moves_as_in_the_file(tmp_path, way):
    path = read_gltf_camera(stored(tmp_path, way), 24)
    assert path.keys[0].frame == 0 and path.keys[-1].frame == 24 and len(path.keys) == 25
    # It looks along -z to begin with, one unit above its own place.
    assert np.allclose(path.at(0).to_world, look_at((0, 2, 4), (0, 2, 3), (0, 1, 0)), atol=1e-6)
    middle = path.at(12)
    assert np.allclose(middle.to_world[:3, 3], [1, 2, 4], atol=1e-6)
    assert np.allclose(middle.to_world[:3, 2], [-0.5, 0, -np.sqrt(0.75)], atol=1e-6)  # turned left by 30 degrees
    assert middle.fov == pytest.approx(45) and middle.fov_axis == "y"
    assert np.isclose(np.linalg.det(middle.to_world), 1)


def read(folder, scene, fps=24):
    (folder / "a.gltf").write_text(json.dumps(scene))
    return read_gltf_camera(folder / "a.gltf", fps)


def test_steps_and_splines(tmp_path):
    assert np.allclose(read(tmp_path, content(embedded, "STEP")[0], 10).at(9).to_world[:3, 3], [0, 2, 4])
    moves, turns = (np.insert(np.zeros((4, keys.shape[1])), [1, 3], keys, axis=0) for keys in (MOVES, TURNS))
    spline = read(tmp_path, content(embedded, "CUBICSPLINE", moves, turns)[0], 10)
    # Without tangents the way eases in and out: 3 t² - 2 t³.
    assert np.isclose(spline.at(2).to_world[0, 3], 2 * (3 * 0.04 - 2 * 0.008))


def test_a_spline_of_any_length_has_the_speed_that_its_tangents_say(tmp_path):
    """A cubic of time, by its values and derivatives at two seconds and at five, is that cubic in between."""
    times, cubic = np.array([2, 5], np.float32), np.polynomial.Polynomial([1, -2, 0.5, 0.1])
    keys = [[cubic.deriv()(t), cubic(t), cubic.deriv()(t)] for t in times]
    moves, turns = np.zeros((6, 3)), np.insert(np.zeros((4, 4)), [1, 3], TURNS, axis=0)
    moves[:, 0] = np.ravel(keys)
    path = read(tmp_path, content(embedded, "CUBICSPLINE", moves, turns, times)[0], 10)
    assert all(np.isclose(path.at(10 * t).to_world[0, 3], cubic(t), atol=1e-5) for t in (2, 2.5, 3.5, 4.8))


NOT_BELOW = "is not in its folder or below"
# The place of a part of the scene, what is there instead, and the complaint
REFUSED = [
    (["nodes", 2], {}, "has no camera"),
    (["cameras", 0, "type"], "orthographic", "must be perspective"),
    (["accessors"], [], "can be understood"),
    (["accessors", 1, "count"], 1000, "can be understood"),
    (["accessors", 0, "componentType"], 5123, "export them as floats"),
    *((["buffers", 0, "uri"], uri, NOT_BELOW) for uri in ("/dev/zero", "a/../../b.bin", "%2e%2e/b.bin")),
    *((["buffers", 0, "uri"], uri, NOT_BELOW) for uri in ("http://a.b/c.bin", "c:\\b.bin")),
    (["buffers", 0, "uri"], "gone.bin", "gone.bin: not found"),
    (["buffers", 0, "uri"], "pipe.bin", "pipe.bin: is a pipe or a device"),
    (["buffers", 0, "uri"], 5, "can be understood"),
    (["buffers", 0, "uri"], INFINITE, "accessor 0 has numbers that are not"),
    (["buffers", 0, "uri"], FALLING, "do not rise"),
    (["animations", 0, "channels", 0, "target"], [], "can be understood"),
    *((["nodes", 1, "translation", 1], far, "frame 0: .* not finite, or beyond") for far in (math.nan, 1e200)),
    (["nodes", 1, "scale"], [0, 1, 1], "frame 0: .* flattens space"),
    (["nodes", 1, "matrix"], [0] * 16, "frame 0: .* flattens space"),
    *((["cameras", 0, "perspective", "yfov"], angle, "yfov .* between 0 and 180") for angle in (math.nan, 0, 10)),
]


@pytest.mark.parametrize(("place", "value", "complaint"), REFUSED)
def test_files_that_cannot_be_used_are_refused(tmp_path, place, value, complaint):
    scene, _ = content(embedded)
    *path, last = place
    reduce(lambda part, key: part[key], path, scene)[last] = value
    os.mkfifo(tmp_path / "pipe.bin")
    with pytest.raises(NgptError, match=complaint):
        read(tmp_path, scene)


@pytest.mark.parametrize("data", [b"glTF123", b"[]", b'"text"', b"5", b"null", b"[" * 100_000, b"\xff\xfe{}"])
def test_what_is_no_gltf_is_refused(tmp_path, data):
    path = tmp_path / "a.gltf"
    path.write_bytes(data)
    with pytest.raises(NgptError, match=r"can be understood|what it holds is"):
        read_gltf_camera(path, 24)
    with pytest.raises(NgptError, match=r"cannot be read|holds no camera keys|key 0"):
        read_camera_path(path)


def test_scaled_cameras_and_parents_are_cameras_without_scale(tmp_path):
    paths = []
    for scale in ([1, 1, 1], [2, 2, 2], [1e-3, 1e-3, 1e-3]):
        scene, _ = content(embedded)
        # The camera's own place is in units of its parent.
        scene["nodes"][1]["scale"], scene["nodes"][2]["scale"] = scale, [3, 4, 5]
        paths.append(read(tmp_path, scene))
    plain, *others = paths
    for other, factor in zip(others, (2, 1e-3), strict=True):
        for one, two in zip(plain.keys, other.keys, strict=True):
            assert np.allclose(one.to_world[:3, :3], two.to_world[:3, :3])
            up = np.array([0, 1, 0])
            assert np.allclose(factor * (one.to_world[:3, 3] - up), two.to_world[:3, 3] - up)


@pytest.mark.parametrize("scale", [[2, 2, 2], [-1, 1, 1]])
def test_mitsuba_renders_scaled_and_mirrored_cameras(renderer, tmp_path, scale):
    import data_gen

    images, camera, how = [], {"type": "perspective", "perspective": {"yfov": 0.7}}, {"size": (17, 12)}
    for given in ([1, 1, 1], scale):
        node = {"camera": 0, "translation": [0, 1, 4], "scale": given}
        (tmp_path / "a.gltf").write_text(json.dumps({"nodes": [node], "cameras": [camera]}))
        shot = data_gen.render_frames("diffuse", [0], 4, sampler="primal", camera=tmp_path / "a.gltf", **how)
        images.append(next(iter(shot))[1]["albedo"])
    assert images[0].std() > 0.01
    mirrored = images[0][:, ::-1] if scale[0] < 0 else images[0]
    # 0.015, by points of other places in each pixel, and 0.15 were it not mirrored.
    assert np.abs(images[1] - mirrored).mean() < 0.04
