"""Adds things that make light hard to find: openings between rooms, lamps of very different power, mirrors, panes.

partition   a wall across a room, with a doorway, a door left ajar, a crack, slats, or a pane of glass in it
lamps       four lamps whose power differs by up to 100 : 1: bare, in shades, in glass, or behind a ledge
mirrors     a large mirror on a wall, and up to two more, or panes that stand in the room
"""

from __future__ import annotations

import numpy as np

from data_gen.scenes.procedural import things
from data_gen.scenes.procedural.meshes import Mesh, box, lathe, merge, quads, sphere, wall
from data_gen.scenes.procedural.stage import Stage
from data_gen.scenes.procedural.textures import colour

# The least distance of a partition from the camera, and the height of a door, in metres
CLEAR, DOOR = 0.5, 2.05


def partition(stage: Stage) -> None:
    """Divides a room or an open set by a wall with a single opening for light."""
    rng, height = stage.rng, stage.height
    # The wall stands across x or, turned by 90 degrees, across z.
    turned = bool(rng.random() < 0.5)
    length, across = (stage.area[0], stage.area[1]) if turned else (stage.area[1], stage.area[0])
    camera = stage.standing[-1][1 if turned else 0]
    places = rng.uniform(-0.3, 0.3, 50) * across
    # In a narrow room no place may be far enough from the camera.
    place = next((c for c in places if abs(c - camera) > CLEAR), max(places, key=lambda c: abs(c - camera)))
    kind = str(rng.choice(["doorway", "ajar", "crack", "slats", "pane"]))
    low, high = (
        (0.0, min(DOOR, 0.95 * height)) if kind in ("doorway", "ajar", "crack") else (0.25 * height, 0.8 * height)
    )
    wide = {
        "doorway": rng.uniform(0.7, 1.6),
        "ajar": rng.uniform(0.7, 1.0),
        "crack": np.exp(rng.uniform(np.log(0.01), np.log(0.1))),
        "slats": rng.uniform(0.3, 0.7) * length,
        "pane": rng.uniform(0.3, 0.7) * length,
    }[kind]
    middle = rng.uniform(-0.5, 0.5) * (length - wide) * 0.8
    u0, u1 = (middle - wide / 2) / length + 0.5, (middle + wide / 2) / length + 0.5
    opening = [(u0, u1, low / height, high / height)]
    # Both faces of a wall 10 cm thick, along z at x = 0
    start, along = [0.05, 0, length / 2], [0, 0, -length]
    behind, back = [-0.05, 0, -length / 2], [0, 0, length]
    parts: list[things.Part] = [
        ("wall", wall(start, along, [0, height, 0], opening)),
        ("wall", wall(behind, back, [0, height, 0], [(1 - u1, 1 - u0, *opening[0][2:])])),
    ]
    z, tall, y = -middle, high - low, (high + low) / 2
    sides = [box([0.12, tall, 0.03], [0, y, z + s * wide / 2]) for s in (-1, 1)]
    parts.append(("wood", merge([*sides, box([0.12, 0.03, wide], [0, high, z])])))
    if kind == "ajar":
        leaf = box([wide, tall, 0.04], [wide / 2, y, 0])
        angle = np.deg2rad(np.exp(rng.uniform(np.log(2), np.log(60))))
        parts.append(("wood", leaf.placed([0, 0, z + wide / 2], np.pi / 2 - angle)))
    elif kind == "slats":
        pitch = rng.uniform(0.03, 0.1)
        depth = pitch * rng.uniform(0.6, 1.3)
        parts.append(("wood", merge([box([depth, 0.004, wide], [0, v, z]) for v in np.arange(low, high, pitch)])))
    elif kind == "pane":
        a, b = z - wide / 2, z + wide / 2
        parts.append(("pane", quads([[[0, low, b], [0, low, a], [0, high, a], [0, high, b]]])))
    if turned:
        stage.add(things.placed(parts, [0, 0, place], -np.pi / 2))
    else:
        stage.add(things.placed(parts, [place, 0, 0]))


def fixture(rng: np.random.Generator, radius: float) -> list[things.Part]:
    """The parts around a lamp of this ``radius``: none, a shade, a glass ball, or a ledge below it."""
    kind = ("bare", "shade", "glass", "ledge")[rng.integers(4)]
    if kind == "shade":
        # A shade that is open below, or above and below
        top, tall = rng.choice([0.001, rng.uniform(1.2, 2.0)]) * radius, rng.uniform(3, 6) * radius
        profile = [(rng.uniform(2.0, 4.0) * radius, -tall / 2), (top, tall / 2)]
        return [(str(rng.choice(["fabric", "metal"])), lathe(profile))]
    if kind == "glass":
        return [("glass", sphere(rng.uniform(1.5, 3.0) * radius, 32))]
    if kind == "ledge":
        return [("wall", box([8 * radius, 0.02, 8 * radius], [0, -1.5 * radius, 0]))]
    return []


def lamps(stage: Stage, count: int) -> list[tuple[Mesh, np.ndarray]]:
    """``count`` lamps, each (mesh, radiance (R, G, B)), anywhere in the room. Their powers differ by up to 1 : 100."""
    rng, (width, depth), height = stage.rng, stage.area, stage.height
    brightest = np.exp(rng.uniform(np.log(20), np.log(250)))
    made = []
    for _ in range(count):
        radius = np.exp(rng.uniform(np.log(0.015), np.log(0.12)))
        place = rng.uniform(-0.45, 0.45, 3) * [width, 0, depth] + [0, rng.uniform(0.3, 0.92) * height, 0]
        stage.add(things.placed(fixture(rng, radius), place))
        power = brightest * 10 ** rng.uniform(-2, 0)
        made.append(
            (sphere(radius, 16).placed(place), power / np.pi / (4 * np.pi * radius**2) * colour(rng, 0.6, 1, 0.5))
        )
    return made


def mirrors(stage: Stage) -> None:
    """One to three large sheets of mirror or glass: on walls, or standing in the room."""
    rng, (width, depth), height = stage.rng, stage.area, stage.height
    for number in range(rng.integers(1, 4)):
        x, y = rng.uniform(0.4, 1.5), rng.uniform(0.3, 0.45) * height
        sheet = quads([[[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]])
        angle = float(rng.integers(4)) * np.pi / 2
        if number and rng.random() < 0.5:
            spot = rng.uniform(-0.3, 0.3, 2) * [width, depth]
            place, role = np.array([spot[0], y + 0.05, spot[1]]), str(rng.choice(["pane", "mirror"]))
        else:
            inward = np.array([np.sin(angle), 0, np.cos(angle)])
            aside = rng.uniform(-0.25, 0.25) * np.array([inward[2] * width, 0, inward[0] * depth])
            place = -inward * ([width, 0, depth] / np.array(2) - 0.03) + aside + [0, height / 2, 0]
            role = "mirror"
        stage.add(things.placed([(role, sheet)], place, angle))
