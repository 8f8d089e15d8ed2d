"""Things to put into a scene. Each is a list of (role, mesh) in metres, and stands on y = 0 around the origin.

The role of a part determines its possible materials, see ``data_gen.scenes.procedural.materials``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.scenes.procedural.meshes import (
    Mesh,
    box,
    cloth,
    cylinder,
    lathe,
    merge,
    quads,
    rock,
    rotation,
    scattered_quads,
    sphere,
    surface,
    torus,
)

Part = tuple[str, Mesh]


def placed(parts: list[Part], position, angle: float = 0.0, scale=1.0) -> list[Part]:
    return [(role, mesh.placed(position, angle, scale)) for role, mesh in parts]


def vessel(rng: np.random.Generator) -> list[Part]:
    """A vase, bowl, bottle or cup: a profile with a thick wall, turned about the vertical."""
    height = rng.uniform(0.08, 0.4)
    rows = np.linspace(0, 1, 24)
    knots = rng.uniform(0.25, 1, 4) * height * rng.uniform(0.3, 0.9)
    radius = np.interp(rows, np.linspace(0, 1, 4), knots)
    radius = np.convolve(np.pad(radius, 3, mode="edge"), np.ones(7) / 7, mode="valid")
    outside = np.stack([radius, rows * height], axis=1)
    wall = max(0.12 * radius.min(), 0.003)
    inside = np.stack([radius - wall, np.maximum(rows * height, wall)], axis=1)[::-1]
    profile = np.concatenate([[(0, 0)], outside, inside, [(0, wall)]])
    return [(str(rng.choice(["object", "glass", "metal", "glass"])), lathe(profile))]


def ball(rng: np.random.Generator) -> list[Part]:
    radius = rng.uniform(0.04, 0.25)
    role = str(rng.choice(["object", "object", "metal", "glass"]))
    return [(role, sphere(radius).placed([0, radius, 0]))]


def block(rng: np.random.Generator) -> list[Part]:
    size = rng.uniform(0.06, 0.35, 3)
    role = str(rng.choice(["object", "object", "object", "metal", "glass"]))
    return [(role, box(size, [0, size[1] / 2, 0]))]


def ring(rng: np.random.Generator) -> list[Part]:
    radius = rng.uniform(0.06, 0.2)
    thickness = radius * rng.uniform(0.12, 0.45)
    mesh = torus(radius, thickness)
    if rng.random() < 0.5:
        return [("object" if rng.random() < 0.5 else "metal", mesh.placed([0, thickness, 0]))]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation([1, 0, 0], np.pi / 2)
    matrix[1, 3] = radius + thickness
    return [("object" if rng.random() < 0.5 else "metal", mesh.transformed(matrix))]


def stone(rng: np.random.Generator) -> list[Part]:
    radius = rng.uniform(0.06, 0.25)
    return [("object", rock(rng, radius, rng.uniform(0.1, 0.5)).placed([0, radius * 0.8, 0]))]


def can(rng: np.random.Generator) -> list[Part]:
    mesh = cylinder(rng.uniform(0.03, 0.12), rng.uniform(0.06, 0.35))
    return [(str(rng.choice(["object", "metal", "glass"])), mesh)]


def books(rng: np.random.Generator) -> list[Part]:
    """A pile of boxes with print on them."""
    parts, height = [], 0.0
    for _ in range(rng.integers(2, 7)):
        size = [rng.uniform(0.14, 0.22), rng.uniform(0.012, 0.045), rng.uniform(0.18, 0.28)]
        role = str(rng.choice(["paper", "object", "fabric"]))
        parts.append((role, box(size).placed([0, height + size[1] / 2, 0], rng.normal(0, 0.2))))
        height += size[1]
    return parts


SMALL: list[Callable[[np.random.Generator], list[Part]]] = [vessel, vessel, ball, block, ring, stone, can, books, books]


def clutter(rng: np.random.Generator, width: float, depth: float, count: int) -> list[Part]:
    """Small things on an area of ``width`` x ``depth``, one in each cell of a grid, so that they do not overlap."""
    columns = max(int(width / 0.28), 1)
    rows = max(int(depth / 0.28), 1)
    cells = rng.permutation(columns * rows)[:count]
    parts = []
    for cell in cells:
        x = (cell % columns + 0.5 + rng.uniform(-0.15, 0.15)) / columns - 0.5
        z = (cell // columns + 0.5 + rng.uniform(-0.15, 0.15)) / rows - 0.5
        thing = SMALL[rng.integers(len(SMALL))](rng)
        reach = max(np.abs(mesh.vertices[:, [0, 2]]).max() for _, mesh in thing)
        parts += placed(thing, [x * width, 0, z * depth], rng.uniform(0, 6.3), min(1, 0.13 / reach))
    return parts


def table(rng: np.random.Generator) -> list[Part]:
    width, depth, height = rng.uniform(0.8, 1.8), rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.8)
    thick = rng.uniform(0.02, 0.06)
    top = str(rng.choice(["wood", "wood", "object", "pane"]))
    parts = [(top, box([width, thick, depth], [0, height - thick / 2, 0]))]
    if rng.random() < 0.7:
        leg = rng.uniform(0.02, 0.05)
        corners = [(i * (width / 2 - leg), j * (depth / 2 - leg)) for i in (-1, 1) for j in (-1, 1)]
        legs = [cylinder(leg, height - thick, 16).placed([x, 0, z]) for x, z in corners]
    else:
        legs = [cylinder(0.05, height - thick, 24), cylinder(0.25, 0.03, 32)]
    parts.append((str(rng.choice(["wood", "metal"])), merge(legs)))
    return parts + placed(clutter(rng, width, depth, int(rng.integers(2, 9))), [0, height, 0])


def chair(rng: np.random.Generator) -> list[Part]:
    height, width = rng.uniform(0.4, 0.5), rng.uniform(0.38, 0.5)
    corners = [(i * width / 2.3, j * width / 2.3) for i in (-1, 1) for j in (-1, 1)]
    legs = [box([0.035, height, 0.035], [x, height / 2, z]) for x, z in corners]
    bars = [box([0.03, 0.5, 0.02], [x, height + 0.25, -width / 2.2]) for x in np.linspace(-0.45, 0.45, 6) * width]
    bars.append(box([width, 0.06, 0.03], [0, height + 0.52, -width / 2.2]))
    seat = box([width, rng.uniform(0.03, 0.1), width], [0, height, 0])
    return [(str(rng.choice(["wood", "metal"])), merge(legs + bars)), (str(rng.choice(["fabric", "wood"])), seat)]


def sofa(rng: np.random.Generator) -> list[Part]:
    width = rng.uniform(1.2, 2.2)
    parts = [box([width, 0.4, 0.8], [0, 0.2, 0]), box([width, 0.5, 0.2], [0, 0.6, -0.35])]
    parts += [box([0.2, 0.55, 0.8], [side * width / 2, 0.28, 0]) for side in (-1, 1)]
    cushions = [
        rock(rng, 0.22, 0.05).placed([x, 0.55, -0.15], rng.normal(), [1, 0.8, 0.45])
        for x in rng.uniform(-0.4, 0.4, rng.integers(1, 4)) * width
    ]
    return [("fabric", merge(parts)), ("object", merge(cushions))]


def shelf(rng: np.random.Generator) -> list[Part]:
    """Boards full of upright books and small things."""
    width, height, depth = rng.uniform(0.6, 1.6), rng.uniform(0.9, 2.2), 0.3
    levels = np.linspace(0.05, height, int(height / 0.38) + 1)
    boards = [box([width, 0.025, depth], [0, y, 0]) for y in levels]
    boards += [box([0.025, height, depth], [side * width / 2, height / 2, 0]) for side in (-1, 1)]
    if rng.random() < 0.6:
        boards.append(box([width, height, 0.01], [0, height / 2, -depth / 2]))
    parts: list[Part] = [("wood", merge(boards))]
    for y in levels[:-1]:
        if rng.random() < 0.3:
            parts += placed(clutter(rng, width - 0.1, depth, 3), [0, y + 0.013, 0])
            continue
        x = -width / 2 + 0.03
        while x < width / 2 - 0.06 and rng.random() < 0.97:
            size = [rng.uniform(0.015, 0.05), rng.uniform(0.18, 0.3), rng.uniform(0.15, 0.22)]
            role = str(rng.choice(["paper", "object", "fabric", "wood"]))
            parts.append((role, box(size, [x + size[0] / 2, y + 0.013 + size[1] / 2, 0.02])))
            x += size[0] + 0.002
    return parts


def plant(rng: np.random.Generator) -> list[Part]:
    height = rng.uniform(0.5, 1.4)
    pot = lathe([(0, 0), (0.13, 0), (0.18, 0.3), (0.16, 0.3), (0.14, 0.25), (0, 0.25)])
    stem = cylinder(0.015, height, 12)
    leaves = scattered_quads(rng, int(rng.integers(60, 500)), rng.uniform(0.2, 0.45), rng.uniform(0.08, 0.2))
    return [("object", pot), ("wood", stem), ("leaf", leaves.placed([0, height, 0], 0, [1, 1.2, 1]))]


def stairs(rng: np.random.Generator) -> list[Part]:
    steps, width, rise = rng.integers(4, 12), rng.uniform(0.8, 1.5), rng.uniform(0.14, 0.2)
    open_risers = rng.random() < 0.5
    treads = []
    for i in range(steps):
        tall = 0.05 if open_risers else (i + 1) * rise
        treads.append(box([width, tall, 0.27], [0, (i + 1) * rise - tall / 2, -0.27 * i]))
    posts = [cylinder(0.012, 0.9, 10).placed([width / 2 - 0.04, (i + 1) * rise, -0.27 * i]) for i in range(steps)]
    return [("wood", merge(treads)), ("metal", merge(posts))]


def screen(rng: np.random.Generator) -> list[Part]:
    """Slats or a grid of bars: fine geometry that casts a pattern of shadows."""
    width, height = rng.uniform(0.8, 1.8), rng.uniform(1.2, 2.2)
    pitch, bar = rng.uniform(0.04, 0.12), rng.uniform(0.008, 0.03)
    parts = [box([bar, height, bar], [x, height / 2, 0]) for x in np.arange(-width / 2, width / 2, pitch)]
    if rng.random() < 0.5:
        parts += [box([width, bar, bar], [0, y, bar]) for y in np.arange(bar, height, pitch)]
    return [(str(rng.choice(["wood", "metal", "object"])), merge(parts))]


def column(rng: np.random.Generator) -> list[Part]:
    height, radius = rng.uniform(0.6, 2.2), rng.uniform(0.1, 0.3)
    plinth = box([2.6 * radius, 0.1, 2.6 * radius], [0, 0.05, 0])
    top = box([2.6 * radius, 0.08, 2.6 * radius], [0, height, 0])
    parts: list[Part] = [("wall", merge([plinth, top, cylinder(radius, height)]))]
    return parts + placed(SMALL[rng.integers(len(SMALL))](rng), [0, height + 0.04, 0], scale=1.5)


def sculpture(rng: np.random.Generator) -> list[Part]:
    thing = SMALL[rng.integers(7)](rng)
    return placed(thing, [0, 0, 0], rng.uniform(0, 6.3), rng.uniform(2, 4.5))


def floor_lamp(rng: np.random.Generator) -> list[Part]:
    """A bulb inside a shade that is open above and below."""
    height = rng.uniform(1.1, 1.7)
    shade = lathe([(rng.uniform(0.14, 0.25), 0), (rng.uniform(0.08, 0.2), 0.28)]).placed([0, height - 0.1, 0])
    bulb = sphere(rng.uniform(0.02, 0.05), 16).placed([0, height, 0])
    stand = merge([cylinder(0.012, height - 0.06, 12), cylinder(0.14, 0.025, 32)])
    return [("metal", stand), ("fabric", shade), ("lamp", bulb)]


def curtain(rng: np.random.Generator) -> list[Part]:
    width, height = rng.uniform(0.6, 1.5), rng.uniform(1.6, 2.2)
    mesh = cloth(rng, width, height, rng.uniform(15, 45), rng.uniform(0.02, 0.06))
    return [("fabric", mesh.placed([-width / 2, 0, 0]))]


def picture(rng: np.random.Generator, width: float, height: float) -> list[Part]:
    """A framed picture in the x-y plane around the origin, with its front toward +z."""
    bar = rng.uniform(0.015, 0.06)
    sides = [box([width + 2 * bar, bar, 0.03], [0, s * (height + bar) / 2, 0.015]) for s in (-1, 1)]
    sides += [box([bar, height, 0.03], [s * (width + bar) / 2, 0, 0.015]) for s in (-1, 1)]
    x, y = width / 2, height / 2
    sheet = quads([[[-x, -y, 0.01], [x, -y, 0.01], [x, y, 0.01], [-x, y, 0.01]]])
    role = str(rng.choice(["paper", "object", "mirror", "fabric"]))
    return [(str(rng.choice(["wood", "metal"])), merge(sides)), (role, sheet)]


LARGE: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    make.__name__: make for make in (table, chair, sofa, shelf, plant, stairs, screen, column, sculpture)
}


SIDES = 4


def tube(points: np.ndarray, radius: float, taper: float = 1.0) -> Mesh:
    """A tube of ``radius`` along ``points`` (n, 3). At its end it is ``taper`` times as thick as at its start."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, [0.31, 0.17, 0.93])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(along, across)
    angle = np.linspace(0, 2 * np.pi, SIDES + 1)[None, :, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * up[:, None]
    thickness = radius * np.linspace(1, taper, len(points))[:, None, None]
    return surface(points[:, None] + thickness * ring)


def wires(rng: np.random.Generator, area: tuple[float, float], height: float) -> list[Part]:
    """Some wires of 0.3 to 2 mm radius that hang across the whole place."""
    strands = []
    for _ in range(rng.integers(3, 12)):
        a, b = rng.uniform(-0.5, 0.5, (2, 3)) * [area[0], 0.35 * height, area[1]] + [0, 0.7 * height, 0]
        t = np.linspace(0, 1, 24)[:, None]
        sag = rng.uniform(0.02, 0.3) * 4 * t * (1 - t)
        strands.append(tube(a + t * (b - a) - sag * [0, 1, 0], rng.uniform(0.0003, 0.002)))
    return [(str(rng.choice(["metal", "object", "fabric"])), merge(strands))]


def tuft(rng: np.random.Generator) -> list[Part]:
    """Grass, bristles or fur: hundreds of bent blades that grow from one place."""
    count, length = rng.integers(150, 500), rng.uniform(0.08, 0.5)
    t = np.linspace(0, 1, 6)[:, None]
    blades = []
    for _ in range(count):
        foot = rng.normal(0, 0.35 * length, 2)
        lean = 1.2 * foot + rng.normal(0, 0.3 * length, 2)
        far = t**2 * lean + foot
        rise = t * length * rng.uniform(0.6, 1)
        blades.append(tube(np.hstack([far[:, :1], rise, far[:, 1:]]), rng.uniform(0.0004, 0.0015), 0.2))
    return [(str(rng.choice(["object", "fabric", "wood"])), merge(blades))]


def net(rng: np.random.Generator) -> list[Part]:
    """A frame strung with threads: a sieve, a harp, a fence."""
    width, height = rng.uniform(0.5, 1.4), rng.uniform(0.6, 1.8)
    pitch, radius = rng.uniform(0.008, 0.04), rng.uniform(0.0003, 0.0015)
    threads = [tube(np.array([[x, 0, 0], [x, height, 0]]), radius) for x in np.arange(-width / 2, width / 2, pitch)]
    if rng.random() < 0.6:
        level = np.arange(0, height, pitch)
        threads += [tube(np.array([[-width / 2, y, 0], [width / 2, y, 0]]), radius) for y in level]
    edge = [[-width / 2, 0, 0], [-width / 2, height, 0], [width / 2, height, 0], [width / 2, 0, 0]]
    frame = [tube(np.array([edge[i], edge[(i + 1) % 4]], float), 0.012) for i in range(4)]
    return [(str(rng.choice(["metal", "fabric", "object"])), merge(threads)), ("metal", merge(frame))]
