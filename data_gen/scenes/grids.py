"""Grids of density made from noise, for smoke and clouds, and a writer of Mitsuba's volume files.

A grid is a (Z, Y, X) float32 array in [0, 1]; +y is up. It is 0 on its border, so its box cannot be seen.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np


def noise(rng: np.random.Generator, shape: tuple[int, int, int], slope: float) -> np.ndarray:
    """Noise that tiles, of mean 0 and deviation 1. The amplitude of its spectrum is frequency^-``slope``."""
    axes = [np.fft.fftfreq(n) for n in shape[:2]] + [np.fft.rfftfreq(shape[2])]
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij")))
    frequency[0, 0, 0] = np.inf
    spectrum = rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)
    field = np.fft.irfftn(spectrum / frequency**slope, s=shape, axes=(0, 1, 2))
    return field / field.std()


def plume(rng: np.random.Generator, shape: tuple[int, int, int] = (32, 48, 32)) -> np.ndarray:
    """Smoke that rises from the middle of the floor of its box, sways and widens, and thins out on top."""
    z, y, x = _coordinates(shape)
    height = (y + 1) / 2
    phases, turns = rng.uniform(0, 2 * np.pi, 2), rng.uniform(3, 7, 2)
    at = [0.25 * height * np.sin(turn * height + phase) for turn, phase in zip(turns, phases, strict=True)]
    radius = 0.16 + rng.uniform(0.5, 0.65) * height
    body = 1 - np.hypot(x - at[0], z - at[1]) / radius + (0.1 + 0.3 * height) * noise(rng, shape, 2.2)
    return _finished(np.clip(3 * body, 0, 1) * np.clip((1 - height) / 0.4, 0, 1))


def cloud(rng: np.random.Generator, shape: tuple[int, int, int] = (32, 32, 48)) -> np.ndarray:
    """A cloud: some round heaps on a flat base."""
    z, y, x = _coordinates(shape)
    field = np.full(shape, -1.0)
    for _ in range(rng.integers(6, 11)):
        place, radius = rng.uniform([-0.6, -0.5], [0.6, 0.5]), rng.uniform(0.35, 0.6)
        high = radius * rng.uniform(0.8, 2.2) * (1 - abs(place[0]))
        across = np.hypot(x - place[0], z - place[1]) / radius
        distance = np.hypot(across, (y + 0.6) / (1.22 * high))
        field = np.maximum(field, 1 - distance)
    base = np.clip((y + 0.75) / 0.2, 0, 1)
    return _finished(np.clip(3 * field + 0.35 * noise(rng, shape, 2.2), 0, 1) * base)


def _coordinates(shape: tuple[int, int, int]) -> tuple[np.ndarray, ...]:
    """z, y and x of the middles of the cells, from -1 to 1."""
    return np.meshgrid(*[(np.arange(n) + 0.5) / n * 2 - 1 for n in shape], indexing="ij")


def _finished(density: np.ndarray) -> np.ndarray:
    """Scales the largest density to 1, and sets the border to 0."""
    inner = np.zeros_like(density)
    inner[1:-1, 1:-1, 1:-1] = density[1:-1, 1:-1, 1:-1]
    return (inner / max(inner.max(), 1e-6)).astype(np.float32)


def write_vol(path: Path, grid: np.ndarray) -> None:
    """Writes Mitsuba's binary file of a ``gridvolume`` in the unit cube, with one float32 channel."""
    depth, height, width = grid.shape
    header = b"VOL\x03" + struct.pack("<iiiii6f", 1, width, height, depth, 1, 0, 0, 0, 1, 1, 1)
    path.write_bytes(header + np.ascontiguousarray(grid, "<f4").tobytes())
