"""Media for a scene: fog, beams in fog, smoke, or coloured liquids in glass, as elements of the scene's file.

Densities depend on the size of the space, so that light is dimmed about as much across a room as across a ball.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from data_gen.scenes.grids import cloud, plume, write_vol
from data_gen.scenes.procedural.materials import add_transform, inside, plugin
from data_gen.scenes.procedural.meshes import box, cylinder, sphere, write_ply
from data_gen.scenes.procedural.stage import Stage
from data_gen.scenes.procedural.textures import colour

# Phase functions: few, since each is compiled separately.
FORWARD = (0.0, 0.3, 0.7)


@dataclass
class MediaElements:
    """``elements`` for the scene itself, and elements for its ``camera``."""

    elements: list[xml.Element] = field(default_factory=list)
    camera: list[xml.Element] = field(default_factory=list)


def fog(stage: Stage, rng: np.random.Generator, folder: Path) -> MediaElements:
    """Grey or slightly coloured fog that fills the place. Its transmittance across the place is e^-0.2 to e^-2."""
    size = np.array([stage.area[0], stage.height, stage.area[1]]) if stage.closed else 3 * np.full(3, stage.area[0])
    depth = np.exp(rng.uniform(np.log(0.2), np.log(2)))
    tint = 1 + rng.uniform(-0.25, 0.25, 3) * (rng.random() < 0.4)
    across = max(stage.area)
    air = _homogeneous(rng, depth / across * tint, np.clip(rng.uniform(0.75, 0.99) * _tinted(rng), 0, 0.995))
    air.set("id", "air")
    # Larger than the room, to contain the window frames; in an open set the fog ends far away
    low, high = [-size[0] / 2 - 0.3, -0.3, -size[2] / 2 - 0.3], [size[0] / 2 + 0.3, size[1] + 0.3, size[2] / 2 + 0.3]
    around = _boundary(low, high, xml.Element("ref", name="interior", id="air"))
    return MediaElements([air, around], [xml.Element("ref", name="medium", id="air")])


def beams(stage: Stage, rng: np.random.Generator, folder: Path) -> MediaElements:
    """Fog as in ``fog``, with two spotlights whose beams are visible in it."""
    media = fog(stage, rng, folder)
    for _ in range(2):
        at = rng.uniform(-0.45, 0.45, 2) * stage.area
        target = -0.5 * at + rng.uniform(-0.1, 0.1, 2) * stage.area
        angle = rng.uniform(6, 22)
        power = np.exp(rng.uniform(np.log(8), np.log(60)))
        light = power / (2 * np.pi * (1 - np.cos(np.radians(angle))))
        intensity = light * colour(rng, 0.7, 1, 0.8)
        spot = plugin("emitter", "spot", cutoff_angle=angle, beam_width=0.8 * angle, intensity=intensity)
        points = {"origin": [at[0], stage.height - 0.05, at[1]], "target": [target[0], 0, target[1]]}
        add_transform(spot, lookat={**points, "up": [1, 0, 0]})
        media.elements.append(spot)
    return media


def smoke(stage: Stage, rng: np.random.Generator, folder: Path) -> MediaElements:
    """Two grids: plumes on the floor, or a cloud that hangs in the air."""
    media = MediaElements()
    for i in range(2):
        width = rng.uniform(0.25, 0.45) * min(*stage.area, 3.5)
        height = min(stage.height - 0.1, width * rng.uniform(1.2, 2.2))
        spot = stage.free_spot(stage.area)
        stage.standing.append((spot[0], spot[1], 0.75 * width))
        hangs = rng.random() < 0.3
        grid = cloud(rng) if hangs else plume(rng)
        write_vol(folder / f"smoke{i}.vol", grid)
        size = np.array([width, 0.7 * width if hangs else height, width])
        floor = np.array([spot[0] - width / 2, 0.03, spot[1] - width / 2])
        if hangs:
            floor[1] = max(floor[1], rng.uniform(0.3, 0.9) * (stage.height - size[1]))
        # The densest column of a grid has 0.3 to 0.8 of its largest density.
        sigma_t = np.exp(rng.uniform(np.log(2), np.log(15))) / width
        media.elements.append(_grid(rng, f"smoke{i}.vol", floor, floor + size, sigma_t))
    return media


def liquid(stage: Stage, rng: np.random.Generator, folder: Path) -> MediaElements:
    """Two glass objects whose inside absorbs and scatters, like ink, milk or amber."""
    media = MediaElements()
    for i in range(2):
        size = rng.uniform(0.1, 0.35)
        kind = str(rng.choice(["ball", "block", "can"]))
        mesh = {
            "ball": sphere(size).placed([0, size, 0]),
            "block": box(size * rng.uniform(0.8, 2.2, 3)),
            "can": cylinder(0.6 * size, rng.uniform(1.5, 3) * size),
        }[kind]
        mesh = mesh.placed([0, 0.002 - mesh.vertices[:, 1].min(), 0])
        spot = stage.free_spot(stage.area)
        stage.standing.append((spot[0], spot[1], 1.5 * size))
        write_ply(folder / f"liquid{i}.ply", mesh.placed([spot[0], 0, spot[1]], rng.uniform(0, 6.3)))
        # The share of light that passes through, in each colour: from a few percent to nearly all
        clear = np.clip(colour(rng, 0.1, 0.95, 2.5), 0.02, 0.98)
        sigma_t = -np.log(clear) / size * np.exp(rng.uniform(np.log(0.5), np.log(3)))
        albedo = np.clip(float(rng.choice([0, 0.5, 0.9, 0.98])) * _tinted(rng), 0, 0.99)
        medium = _homogeneous(rng, sigma_t, albedo)
        medium.set("name", "interior")
        shape = plugin("shape", "ply", filename=f"liquid{i}.ply")
        media.elements.append(inside(shape, plugin("bsdf", "dielectric", int_ior=1.5), medium))
    return media


Maker = Callable[[Stage, np.random.Generator, Path], MediaElements]
KINDS: dict[str, Maker] = {made.__name__: made for made in (fog, beams, smoke, liquid)}


def some_media(stage: Stage, rng: np.random.Generator, folder: Path) -> MediaElements:
    """Media of a random kind, with their files in ``folder``."""
    return KINDS[str(rng.choice(list(KINDS), p=[0.35, 0.2, 0.3, 0.15]))](stage, rng, folder)


def _tinted(rng: np.random.Generator) -> np.ndarray:
    return colour(rng, 1, 1, 0.5)


def _phase(rng: np.random.Generator) -> xml.Element:
    return plugin("phase", "hg", g=float(rng.choice(FORWARD)))


def _homogeneous(rng: np.random.Generator, sigma_t: np.ndarray, albedo: np.ndarray) -> xml.Element:
    # Colours are at most 1 in Mitsuba.
    most = float(np.max(sigma_t))
    return inside(plugin("medium", "homogeneous", sigma_t=sigma_t / most, scale=most, albedo=albedo), _phase(rng))


def _grid(rng: np.random.Generator, file: str, low: np.ndarray, high: np.ndarray, sigma_t: float) -> xml.Element:
    medium = plugin("medium", "heterogeneous", "interior", scale=sigma_t)
    volume = plugin("volume", "gridvolume", "sigma_t", filename=file, raw=True)
    add_transform(volume, scale={"value": high - low}, translate={"value": low})
    value = np.clip(float(rng.choice([0.4, 0.8, 0.95, 0.99])) * _tinted(rng), 0, 0.995)
    albedo = plugin("volume", "constvolume", "albedo", value=value)
    return _boundary(low, high, inside(medium, volume, albedo, _phase(rng)))


def _boundary(low, high, medium: xml.Element) -> xml.Element:
    """An invisible box with a medium in it."""
    low, high = np.asarray(low), np.asarray(high)
    shape = plugin("shape", "cube")
    add_transform(shape, scale={"value": (high - low) / 2}, translate={"value": (high + low) / 2})
    return inside(shape, plugin("bsdf", "null"), medium)
