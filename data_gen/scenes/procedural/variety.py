"""Sights, which are rare features of scenes: fine pictures, hair, many small lamps, caustics, media, and light that is
hard to find (``data_gen.scenes.procedural.hard_light``).

They are added to a finished scene and use separate random numbers, so a scene without sights does not depend on this
file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from data_gen.scenes.procedural import hard_light, things
from data_gen.scenes.procedural.meshes import Mesh, box, cylinder, lathe, merge, sphere, torus
from data_gen.scenes.procedural.stage import Stage
from data_gen.scenes.procedural.textures import colour

# The default probability of each sight; sights are independent. The LATER ones use separate random numbers, so scenes
# without them are the same as before these sights existed.
LATER = {"partition": 0.0, "lamps": 0.0, "mirrors": 0.0}
SHARES = {"fine": 0.25, "hair": 0.25, "bulbs": 0.15, "caustic": 0.15, "media": 0.16} | LATER

# Small lamps are always this number of emitters, since kernels depend on it.
EMITTERS = 4

# (radius, height) along the profile of a dish, first outside, then inside
DISH = np.array([(0, 0), (1, 0), (1.3, 1), (1.15, 1), (0.85, 0.15), (0, 0.12)])


@dataclass(frozen=True)
class MeshLamp:
    """A mesh that emits ``radiance`` (R, G, B)."""

    mesh: Mesh
    radiance: np.ndarray


def further_sights(
    seed: int | tuple[int, ...], shares: Mapping[str, float] = SHARES
) -> tuple[frozenset[str], np.random.Generator]:
    """The names of the sights of the scene of ``seed``, and the random numbers to make them.

    ``shares`` has all names of ``SHARES``, in the same order.
    """
    parts = seed if isinstance(seed, tuple) else (seed,)
    rng, later = (np.random.default_rng((*parts, salt)) for salt in (0x5EE, 0x5EF))
    drawn = {name: (later if name in LATER else rng).random() for name in shares}
    return frozenset(name for name, share in shares.items() if drawn[name] < share), rng


def add_sights(stage: Stage, sights: frozenset[str], rng: np.random.Generator) -> list[MeshLamp]:
    """Puts all ``sights`` except media on the stage. Returns their lamps: ``EMITTERS`` lamps or none."""
    before, stage.rng = stage.rng, rng
    lamps: list[MeshLamp] = []
    if "partition" in sights:
        hard_light.partition(stage)
    if "mirrors" in sights:
        hard_light.mirrors(stage)
    if "hair" in sights:
        hair(stage)
    # "caustic" and "bulbs" already use all additional lamps that a scene may have.
    if "lamps" in sights and not sights & {"caustic", "bulbs"}:
        lamps = [MeshLamp(*lamp) for lamp in hard_light.lamps(stage, EMITTERS)]
    if "caustic" in sights:
        lamps = caustic(stage)
    if "bulbs" in sights:
        # If there is a caustic, its lamp stays one of the emitters.
        lamps = bulbs(stage, lamps)
    if "fine" in sights:
        fine_pictures(stage)
    stage.rng = before
    return lamps


def fine_pictures(stage: Stage) -> None:
    """Makes the pictures on some materials so small that their details are as large as pixels."""
    slots = [slot for slot in stage.meshes if slot not in ("lamp", "leaf")]
    for slot in stage.rng.permutation(slots)[: stage.rng.integers(1, 4)]:
        times = np.exp(stage.rng.uniform(np.log(3), np.log(12)))
        stage.meshes[slot] = [replace(mesh, uvs=mesh.uvs * times) for mesh in stage.meshes[slot]]


def hair(stage: Stage) -> None:
    """Wires overhead, tufts, nets, or several of them."""
    rng = stage.rng
    kinds = rng.permutation(["wires", "tuft", "net"])[: rng.integers(1, 4)]
    if "wires" in kinds:
        stage.add(things.wires(rng, stage.area, stage.height))
    if "tuft" in kinds:
        for _ in range(rng.integers(1, 4)):
            stage.stand(things.tuft(rng), stage.area)
    if "net" in kinds:
        stage.stand(things.net(rng), stage.area)


def bulbs(stage: Stage, others: list[MeshLamp]) -> list[MeshLamp]:
    """10 to 50 small lamps: strings of bulbs, a grid under the ceiling, or scattered candles; and the ``others``."""
    rng, (width, depth), height = stage.rng, stage.area, stage.height
    count, radius = int(rng.integers(10, 51)), rng.uniform(0.006, 0.03)
    kind = str(rng.choice(["strings", "grid", "candles"]))
    if kind == "strings":
        ends = rng.uniform(-0.48, 0.48, (4, 2)) * [width, depth]
        t, string = rng.uniform(0, 1, count), rng.integers(0, 3, count)
        x, z = (ends[string] + t[:, None] * (ends[string + 1] - ends[string])).T
        y = 0.85 * height - 0.25 * 4 * t * (1 - t)
    elif kind == "grid":
        columns = int(np.ceil(np.sqrt(count)))
        cell = np.stack(np.divmod(np.arange(count), columns), axis=1)
        x, z = (((cell + 0.5) / columns - 0.5) * [width, depth]).T * 0.9
        y = np.full(count, height - 0.05)
    else:
        x, z = (rng.uniform(-0.48, 0.48, (count, 2)) * [width, depth]).T
        y = rng.uniform(0.1, 0.5, count) * height
    places = np.stack([x, y, z], axis=1)
    groups = EMITTERS - (1 if others else 0)
    meshes = [merge([sphere(radius, 8).placed(p) for p in places[i::groups]]) for i in range(groups)]
    power = np.exp(rng.uniform(np.log(10), np.log(120)))
    tints = [colour(rng, 0.6, 1, rng.choice([0.3, 1.5])) for _ in meshes]
    light = power / np.pi / (4 * np.pi * radius**2 * count)
    if others:
        others = [MeshLamp(merge([lamp.mesh for lamp in others]), others[0].radiance)]
    return others + [MeshLamp(mesh, light * tint) for mesh, tint in zip(meshes, tints, strict=True)]


def caustic(stage: Stage) -> list[MeshLamp]:
    """A glass object or a polished ring, which focuses the light of a small lamp on the floor or on a slab."""
    rng = stage.rng
    size = rng.uniform(0.08, 0.22)
    kind = str(rng.choice(["ball", "can", "dish", "ring"]))
    meshes = {
        "ball": sphere(size).placed([0, 1.02 * size, 0]),
        "can": cylinder(0.6 * size, 1.8 * size).placed([0, 0.002, 0]),
        "dish": lathe(size * DISH),
        "ring": torus(size, 0.15 * size).placed([0, 0.15 * size, 0], 0, [1, 3, 1]),
    }
    tall = float(rng.choice([0, rng.uniform(0.3, 0.8)]))
    parts = [("wall", box([0.9, tall, 0.9], [0, tall / 2, 0]))] if tall else []
    spot = stage.free_spot(stage.area)
    stage.add([(role, mesh.placed([spot[0], 0, spot[1]])) for role, mesh in parts])
    stage.standing.append((spot[0], spot[1], 0.6))
    place = np.array([spot[0], tall + 0.001, spot[1]])
    slot = "mirror" if kind == "ring" else "glass"
    stage.meshes.setdefault(slot, []).append(meshes[kind].placed(place))
    angle, rise, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.2), rng.uniform(4, 8) * size
    toward = np.array([np.cos(angle) * np.cos(rise), np.sin(rise), np.sin(angle) * np.cos(rise)])
    radius = rng.uniform(0.01, 0.035)
    lamp = sphere(radius, 24).placed(place + [0, size, 0] + far * toward)
    light = np.exp(rng.uniform(np.log(5), np.log(60))) / np.pi / (4 * np.pi * radius**2)
    radiance = light * colour(rng, 0.8, 1, 0.4)
    return [MeshLamp(replace(lamp, faces=faces), radiance) for faces in np.array_split(lamp.faces, EMITTERS)]
