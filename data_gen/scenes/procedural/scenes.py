"""Any number of scenes: rooms and open sets made from a seed, written as Mitsuba scene files.

A scene is a folder with ``scene.xml``, one mesh for each material, and the pictures. Units are metres, and +y is up.
The camera stands in free space and looks at the middle of the scene; ``data_gen.dataset.cameras`` finds more cameras
from there.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import numpy as np

from data_gen.scenes.procedural import things
from data_gen.scenes.procedural.materials import SLOTS, Palette, add_transform, inside, plugin
from data_gen.scenes.procedural.media import MediaElements, some_media
from data_gen.scenes.procedural.meshes import (
    Mesh,
    box,
    cylinder,
    lathe,
    merge,
    quads,
    sphere,
    wall,
    write_ply,
)
from data_gen.scenes.procedural.stage import Stage
from data_gen.scenes.procedural.textures import colour, sky, write_pfm
from data_gen.scenes.procedural.variety import SHARES, add_sights, further_sights
from ngpt.image.display import to_srgb8
from ngpt.image.png import encode_png

MAX_DEPTH = 12


def room(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """A room with furniture, lit by lamps, windows or both. Returns the origin and target of its camera."""
    rng = stage.rng
    width, depth, height = rng.uniform(3, 8), rng.uniform(3, 8), rng.uniform(2.3, 3.6)
    stage.area, stage.height, stage.closed = (width, depth), height, True
    x, z = width / 2, depth / 2
    stage.add([("floor", quads([[[-x, 0, z], [x, 0, z], [x, 0, -z], [-x, 0, -z]]]))])
    stage.add([("wall", quads([[[-x, height, -z], [x, height, -z], [x, height, z], [-x, height, z]]]))])
    daylight = rng.random() < 0.55
    corners = np.array([[-x, -z], [x, -z], [x, z], [-x, z]])[::-1]
    with_windows: Any = rng.permutation(4)[: rng.integers(1, 3)] if daylight else []
    for side in range(4):
        start, end = corners[side], corners[(side + 1) % 4]
        _side(stage, start, end, height, side in with_windows)
    stage.sky = daylight
    if not daylight or rng.random() < 0.7:
        _lamps(stage, width, depth, height)
    names = rng.choice(list(things.LARGE), rng.integers(5, 12))
    for name in names:
        stage.stand(things.LARGE[str(name)](rng), (width, depth), float(rng.choice([0, 0.5, 1, 1.5])) * np.pi)
    if rng.random() < 0.5:
        stage.add(things.placed([("fabric", box([2.2, 0.012, 1.5]))], [rng.uniform(-1, 1), 0.006, rng.uniform(-1, 1)]))
    spot = stage.free_spot((width, depth))
    return np.array([spot[0], rng.uniform(0.9, 1.8), spot[1]]), np.array([-0.3 * spot[0], 0.8, -0.3 * spot[1]])


def _side(stage: Stage, start, end, height: float, windows: bool) -> None:
    """Adds a wall of a room, with windows (bars, panes, blinds, curtains) or with pictures."""
    rng = stage.rng
    length = float(np.linalg.norm(end - start))
    u = np.array([end[0] - start[0], 0, end[1] - start[1]])
    origin = np.array([start[0], 0, start[1]])
    inward = np.cross(u / length, [0, 1, 0])
    angle = np.arctan2(inward[0], inward[2])
    if not windows:
        stage.add([("wall", wall(origin, u, [0, height, 0]))])
        stage.add([("wood", box([length, 0.1, 0.02]).placed(origin + u / 2 + [0, 0.05, 0] + 0.01 * inward, angle))])
        for place in rng.uniform(0.15, 0.85, rng.integers(0, 3)):
            picture = things.picture(rng, *rng.uniform(0.3, 1.2, 2))
            stage.add(things.placed(picture, origin + place * u + [0, 1.5, 0] + 0.01 * inward, angle))
        return
    count = int(rng.integers(1, 1 + max(1, int(length / 1.8))))
    low, high = rng.uniform(0.02, 0.35), rng.uniform(0.75, 0.95)
    span = rng.uniform(0.5, 0.95) / count
    openings = [((i + 0.5) / count - span / 2, (i + 0.5) / count + span / 2, low, high) for i in range(count)]
    stage.add([("wall", wall(origin, u, [0, height, 0], openings))])
    blinds, bars = rng.random() < 0.2, int(rng.integers(0, 4))
    for u0, u1, v0, v1 in openings:
        wide, tall = (u1 - u0) * length, (v1 - v0) * height
        middle = origin + (u0 + u1) / 2 * u + [0, (v0 + v1) / 2 * height, 0]
        frame = [box([wide, 0.05, 0.08], [0, s * tall / 2, 0]) for s in (-1, 1)]
        frame += [box([0.05, tall, 0.08], [s * wide / 2, 0, 0]) for s in (-1, 1)]
        frame += [box([0.03, tall, 0.04], [t * wide, 0, 0]) for t in (np.arange(bars) + 1) / (bars + 1) - 0.5]
        parts: list[things.Part] = [("wood", merge(frame))]
        if rng.random() < 0.35:
            x, y = wide / 2, tall / 2
            parts.append(("pane", quads([[[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]])))
        if blinds:
            slats = [box([wide, 0.004, 0.04], [0, y, 0.08]) for y in np.arange(-tall / 2, tall / 2, 0.05)]
            parts.append(("wood", merge(slats)))
        elif rng.random() < 0.4:
            side = rng.choice([-1, 1]) * wide / 2
            parts += things.placed(things.curtain(rng), [side, -middle[1] + 0.03, 0.12])
        stage.add(things.placed(parts, middle, angle))


def _lamps(stage: Stage, width: float, depth: float, height: float) -> None:
    """Adds a panel, a globe, spots under the ceiling, a strip behind a ledge or a shaded lamp; and floor lamps."""
    rng = stage.rng
    kind = str(rng.choice(["panel", "panel", "globe", "points", "cove", "shade"]))
    x, z = rng.uniform(-0.25, 0.25, 2) * [width, depth]
    if kind == "panel":
        size = rng.uniform(0.2, 1.5, 2)
        parts: list[things.Part] = [("lamp", box([size[0], 0.04, size[1]], [x, height - 0.1, z]))]
    elif kind == "globe":
        drop = rng.uniform(0.3, 0.9)
        parts = [("lamp", sphere(rng.uniform(0.04, 0.18)).placed([x, height - drop, z]))]
        parts.append(("metal", cylinder(0.008, drop, 10).placed([x, height - drop, z])))
    elif kind == "points":
        places = rng.uniform(-0.4, 0.4, (rng.integers(3, 8), 2)) * [width, depth]
        parts = [("lamp", cylinder(0.035, 0.01, 16).placed([a, height - 0.03, b])) for a, b in places]
    elif kind == "cove":
        ledge = box([width - 0.1, 0.12, 0.03], [0, height - 0.3, 0.25 - depth / 2])
        board = box([width - 0.1, 0.03, 0.25], [0, height - 0.36, 0.125 - depth / 2])
        strip = box([width - 0.4, 0.02, 0.03], [0, height - 0.33, 0.1 - depth / 2])
        parts = [("wall", merge([ledge, board])), ("lamp", strip)]
    else:
        shade = lathe([(rng.uniform(0.15, 0.35), 0), (0.06, rng.uniform(0.15, 0.35))])
        drop = rng.uniform(0.4, 1.0)
        parts = things.placed([("metal", shade), ("lamp", sphere(0.05, 16))], [x, height - drop, z])
    stage.add(parts)
    for _ in range(rng.integers(0, 3)):
        stage.stand(things.floor_lamp(rng), (width, depth))


def open_set(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """As ``room``, for things on a ground without walls, under a sky or between the lamps of a studio."""
    rng = stage.rng
    small = rng.random() < 0.4
    area = stage.area = (1.6, 1.6) if small else (7.0, 7.0)
    stage.height = 1.2 if small else 2.6
    stage.add([("floor", quads([[[-60, 0, 60], [60, 0, 60], [60, 0, -60], [-60, 0, -60]]]))])
    if small:
        stage.add(things.clutter(rng, *area, int(rng.integers(6, 22))))
    else:
        for name in rng.choice([*things.LARGE, "sculpture", "sculpture", "plant"], rng.integers(5, 14)):
            stage.stand(things.LARGE[str(name)](rng), area)
    stage.sky = rng.random() < 0.65
    if not stage.sky or rng.random() < 0.3:
        for _ in range(rng.integers(1, 4)):
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.3) * area[0]
            size = np.append(np.exp(rng.uniform(np.log(0.06), np.log(0.7), 2)), 0.02) * area[0]
            place = [far * np.sin(angle), rng.uniform(0.5, 1.2) * area[0], far * np.cos(angle)]
            stage.add([("lamp", box(size).placed(place, angle))])
    if not stage.sky or rng.random() < 0.4:
        back = wall([-area[0], 0, -area[0]], [2 * area[0], 0, 0], [0, 1.5 * area[0], 0])
        stage.add([("wall", back)])
    spot = stage.free_spot(area)
    if small:
        angle = rng.uniform(-1.2, 1.2)
        return np.array([2 * np.sin(angle), rng.uniform(0.4, 1.4), 2 * np.cos(angle)]), np.array([0, 0.1, 0])
    return np.array([spot[0], rng.uniform(0.8, 2.0), spot[1]]), np.array([-0.2 * spot[0], 0.7, -0.2 * spot[1]])


LAYOUTS = {"room": room, "open": open_set}


def make_scene(seed: int | tuple[int, ...], folder: Path, shares: Mapping[str, float] | None = None) -> Path:
    """Makes the scene of ``seed`` in the (existing, empty) ``folder``; returns its file. Equal seeds give equal files.

    ``shares`` has a probability (0 to 1) for each sight in ``data_gen.scenes.procedural.variety.SHARES``. Without
    ``shares`` there are no sights.
    """
    rng = np.random.default_rng(seed)
    layout = "room" if rng.random() < 0.7 else "open"
    stage = Stage(rng)
    origin, target = LAYOUTS[layout](stage)
    sights, further = further_sights(seed, shares) if shares else (frozenset(), rng)
    # No further thing may stand at the camera.
    stage.standing.append((origin[0], origin[2], 0.6))
    bulbs = add_sights(stage, sights, further)
    media = some_media(stage, further, folder) if "media" in sights else MediaElements()

    def save(image: np.ndarray, raw: bool) -> str:
        image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)
        pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8) if raw else to_srgb8(image)
        name = f"picture{len(list(folder.glob('picture*.png')))}.png"
        (folder / name).write_bytes(encode_png(pixels, level=1))
        return name

    root = xml.Element("scene", version="3.0.0")
    integrator = "volpath" if media.elements else "path"
    root.append(plugin("integrator", integrator, max_depth=MAX_DEPTH, rr_depth=5))
    root.append(inside(_camera(rng, origin, target), *media.camera))
    palette = Palette(rng, save)
    for slot in SLOTS:
        # A material that this scene does not use gets a placeholder far below the floor, where no camera looks.
        mesh = merge(stage.meshes.get(slot, [box([0.01] * 3, [0, -50, 0])]))
        root.append(_shape(folder, slot, mesh, palette.material(slot)))
    black = plugin("bsdf", "diffuse", reflectance=(0.0, 0.0, 0.0))
    if "lamp" in stage.meshes:
        lamps = merge(stage.meshes["lamp"])
        power = np.exp(rng.uniform(np.log(10), np.log(250)))
        light = power / max(_surface(lamps), 0.01) / np.pi
        # Always two emitters: a single one would need a different kernel.
        middle = len(stage.meshes["lamp"][0].faces) if len(stage.meshes["lamp"]) > 1 else len(lamps.faces) // 2
        for name, part in (("lamp0", np.s_[:middle]), ("lamp1", np.s_[middle:])):
            shape = _shape(folder, name, replace(lamps, faces=lamps.faces[part]), black)
            tint = colour(rng, 0.75, 1, 0.5)
            root.append(inside(shape, plugin("emitter", "area", radiance=light * tint)))
    for i, lamp in enumerate(bulbs):
        shape = _shape(folder, f"bulb{i}", lamp.mesh, black)
        root.append(inside(shape, plugin("emitter", "area", radiance=lamp.radiance)))
    root.extend(media.elements)
    if stage.sky:
        write_pfm(folder / "sky.pfm", np.float32(np.exp(rng.normal(0, 1))) * sky(rng))
        root.append(plugin("emitter", "envmap", filename="sky.pfm"))
    xml.indent(root)
    xml.ElementTree(root).write(folder / "scene.xml", encoding="utf-8")
    return folder / "scene.xml"


def _camera(rng: np.random.Generator, origin, target) -> xml.Element:
    lens = plugin("sensor", "thinlens", fov=rng.uniform(45, 75), aperture_radius=1e-4, focus_distance=2.0)
    add_transform(lens, lookat={"origin": origin, "target": target, "up": [0, 1, 0]})
    film = plugin("film", "hdrfilm", width=1280, height=720, pixel_format="rgb", component_format="float32")
    return inside(lens, inside(film, plugin("rfilter", "box")))


def _shape(folder: Path, name: str, mesh: Mesh, bsdf: xml.Element) -> xml.Element:
    write_ply(folder / f"{name}.ply", mesh)
    return inside(plugin("shape", "ply", filename=f"{name}.ply"), bsdf)


def _surface(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def main() -> int:
    words = [word for word in sys.argv[1:] if word != "--varied"]
    if len(words) != 2 or not words[0].isdigit():
        print("usage: python -m data_gen.scenes.procedural.scenes SEED FOLDER [--varied]", file=sys.stderr)
        return 2
    folder = Path(words[1])
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        print(f"{folder}: exists and is not an empty folder; give a new one", file=sys.stderr)
        return 2
    folder.mkdir(parents=True, exist_ok=True)
    print(make_scene(int(words[0]), folder, SHARES if "--varied" in sys.argv else None))
    return 0


if __name__ == "__main__":
    sys.exit(main())
