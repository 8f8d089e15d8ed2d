"""A scene under construction: its parts by slot of material, and the places of things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_gen.scenes.procedural import things
from data_gen.scenes.procedural.materials import ROLES
from data_gen.scenes.procedural.meshes import Mesh, rotation

SIZES = {"wall": (0.7, 4), "floor": (0.4, 3), "paper": (0.15, 0.6)}


class Stage:
    """Parts by slot of material, and the places of things on the floor."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.meshes: dict[str, list[Mesh]] = {}
        self.standing: list[tuple[float, float, float]] = []
        self.sky = False
        # The size of a room or an open set in metres: (x, z), and y; ``closed`` says whether it has walls.
        self.area, self.height, self.closed = (4.0, 4.0), 2.4, False
        # The slots of each role. With few slots a scene looks uniform, with many it looks mixed.
        self.cast = {role: rng.permutation(slots)[: rng.integers(1, len(slots) + 1)] for role, slots in ROLES.items()}

    def add(self, parts: list[things.Part]) -> None:
        for role, mesh in parts:
            slot = str(self.rng.choice(self.cast[role]))
            if role != "leaf":
                # The size in metres that the picture covers
                low, high = SIZES.get(role, (0.1, 1.5))
                size = np.exp(self.rng.uniform(np.log(low), np.log(high)))
                turn = rotation([0, 0, 1], float(self.rng.choice([0, 0, 0, 0.25, 0.5])) * np.pi)[:2, :2]
                mesh = replace(mesh, uvs=mesh.uvs @ turn / size)
            self.meshes.setdefault(slot, []).append(mesh)

    def stand(self, parts: list[things.Part], area: tuple[float, float], angle: float | None = None) -> bool:
        """Puts a thing on a free place of the floor, x and z within ``area`` / 2. False if it finds no place."""
        reach = max(np.hypot(*mesh.vertices[:, [0, 2]].T).max() for _, mesh in parts)
        for _ in range(20):
            x, z = (self.rng.uniform(-0.5, 0.5, 2)) * np.maximum(np.array(area) - 2 * reach, 0)
            if all(np.hypot(x - a, z - b) > 0.85 * (reach + r) for a, b, r in self.standing):
                self.standing.append((x, z, reach))
                turn = self.rng.uniform(0, 2 * np.pi) if angle is None else angle
                self.add(things.placed(parts, [x, 0, z], turn))
                return True
        return False

    def free_spot(self, area: tuple[float, float]) -> np.ndarray:
        """The place (x, z) on the floor, of 200 random ones, that is farthest from all things."""
        spots = self.rng.uniform(-0.45, 0.45, (200, 2)) * area
        gaps = [min([np.hypot(*(spot - [x, z])) - r for x, z, r in self.standing], default=1.0) for spot in spots]
        return spots[int(np.argmax(gaps))]
