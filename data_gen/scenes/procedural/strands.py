"""Things as thin as hair: wires, tufts and nets, of tubes that are a pixel wide or less from where cameras stand."""

from __future__ import annotations

import numpy as np

from data_gen.scenes.procedural.meshes import Mesh, merge, surface
from data_gen.scenes.procedural.things import Part

SIDES = 4


def tube(points: np.ndarray, radius: float, taper: float = 1.0) -> Mesh:
    """A tube of ``radius`` along ``points`` (n, 3), ``taper`` times as thick at its end as where it starts."""
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
    """Some wires that hang across the whole place, of 0.3 to 2 mm radius."""
    strands = []
    for _ in range(rng.integers(3, 12)):
        a, b = rng.uniform(-0.5, 0.5, (2, 3)) * [area[0], 0.35 * height, area[1]] + [0, 0.7 * height, 0]
        t = np.linspace(0, 1, 24)[:, None]
        sag = rng.uniform(0.02, 0.3) * 4 * t * (1 - t)
        strands.append(tube(a + t * (b - a) - sag * [0, 1, 0], rng.uniform(0.0003, 0.002)))
    return [(str(rng.choice(["metal", "object", "fabric"])), merge(strands))]


def tuft(rng: np.random.Generator) -> list[Part]:
    """Grass, bristles or fur: hundreds of bent blades that grow out of a spot."""
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
