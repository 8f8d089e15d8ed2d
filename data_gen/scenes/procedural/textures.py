"""Pictures made in code for walls, floors and things; and skies.

A pattern is a (H, W) array in [0, 1] that tiles; ``coloured`` lays two or three colours over it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

SIZE = 256


def noise(rng: np.random.Generator, slope: float = 1.0, stretch: float = 1.0) -> np.ndarray:
    """Tileable noise in [0, 1] with a spectrum of amplitude frequency^-``slope``; ``stretch`` lengthens it along
    rows."""
    y = np.fft.fftfreq(SIZE)[:, None] * SIZE
    x = np.fft.rfftfreq(SIZE)[None, :] * SIZE * stretch
    frequency = np.hypot(x, y)
    frequency[0, 0] = np.inf
    spectrum = rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)
    field = np.fft.irfft2(spectrum / frequency**slope, s=(SIZE, SIZE))
    return np.clip(0.5 + field / (5 * field.std()), 0, 1)


def marble(rng: np.random.Generator) -> np.ndarray:
    return np.abs(2 * noise(rng, 1.6) - 1) ** rng.uniform(0.4, 1)


def wood(rng: np.random.Generator) -> np.ndarray:
    """Boards with grain along u."""
    boards = int(rng.choice([2, 4, 8]))
    row = np.arange(SIZE) * boards // SIZE
    shift = rng.integers(0, SIZE, boards)[row]
    column = (np.arange(SIZE)[None, :] + shift[:, None]) % SIZE
    grain = noise(rng, 1.2, stretch=rng.uniform(6, 16))[np.arange(SIZE)[:, None], column]
    tone = rng.uniform(0.6, 1, boards)[row][:, None]
    seam = (np.arange(SIZE) * boards % SIZE < boards * 2)[:, None]
    return np.where(seam, 0.1, grain * tone)


def bricks(rng: np.random.Generator) -> np.ndarray:
    rows = int(rng.choice([4, 8, 16]))
    columns = rows // 2
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    row = (y * rows).astype(int)
    u = x * columns + 0.5 * (row % 2)
    joint = (u % 1 < 0.05) | (y * rows % 1 < 0.1)
    tone = rng.uniform(0.45, 1, (rows, columns))[row, u.astype(int) % columns]
    return np.where(joint, 0.05, tone * (0.75 + 0.25 * noise(rng, 0.5)))


def checks(rng: np.random.Generator) -> np.ndarray:
    cells = int(rng.choice([2, 4, 8, 16]))
    index = np.arange(SIZE) * cells // SIZE
    return ((index[:, None] + index[None]) % 2).astype(float)


def stripes(rng: np.random.Generator) -> np.ndarray:
    count = int(rng.choice([2, 4, 8, 16, 32]))
    ramp = np.arange(SIZE) * count % SIZE / SIZE
    pattern = np.broadcast_to(ramp < rng.uniform(0.2, 0.8), (SIZE, SIZE)).astype(float)
    return pattern if rng.random() < 0.5 else pattern.T


def weave(rng: np.random.Generator) -> np.ndarray:
    count = int(rng.choice([8, 16, 32]))
    y, x = np.mgrid[0:SIZE, 0:SIZE] * 2 * np.pi * count / SIZE
    return np.clip(0.5 + 0.35 * np.sin(x) * np.cos(y) + 0.3 * (noise(rng, 0.6) - 0.5), 0, 1)


def dots(rng: np.random.Generator) -> np.ndarray:
    cells = int(rng.choice([2, 4, 8]))
    y, x = np.mgrid[0:SIZE, 0:SIZE] * cells / SIZE % 1 - 0.5
    return (np.hypot(x, y) < rng.uniform(0.15, 0.45)).astype(float)


def text(rng: np.random.Generator) -> np.ndarray:
    """Lines of random glyphs that look like print from afar, with high contrast at the scale of pixels."""
    page = np.ones((SIZE, SIZE))
    height = int(rng.choice([8, 16, 32]))
    for top in range(height // 2, SIZE - height, height + height // 3):
        left = height // 2
        while left < SIZE - height:
            if rng.random() < 0.83:
                glyph = rng.random((5, 3)) < 0.55
                block = np.kron(glyph, np.ones((height // 8 + 1, height // 8 + 1)))
                area = page[top : top + block.shape[0], left : left + block.shape[1]]
                area[block[: area.shape[0], : area.shape[1]] > 0] = 0
            left += height // 2 + 1
    return page


def blots(rng: np.random.Generator) -> np.ndarray:
    """Flat regions with sharp, winding edges."""
    levels = int(rng.integers(2, 5))
    return np.floor(noise(rng, 1.8) * 0.999 * levels * 2) % levels / max(levels - 1, 1)


PATTERNS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "noise": lambda rng: noise(rng, rng.uniform(0.4, 1.8)),
    **{make.__name__: make for make in (marble, wood, bricks, checks, stripes, weave, dots, text, blots)},
}


def colour(rng: np.random.Generator, low: float = 0.08, high: float = 0.8, saturation: float = 1.0) -> np.ndarray:
    """A linear RGB reflectance of any hue, mostly with low saturation, as for things in houses."""
    value = rng.uniform(low, high)
    saturation *= rng.beta(1.0, 2.6)
    hue = np.clip(np.abs((rng.random() * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    return value * (1 - saturation + saturation * hue)


def coloured(rng: np.random.Generator, pattern: np.ndarray, low: float = 0.06, high: float = 0.8) -> np.ndarray:
    """(H, W, 3) linear reflectance: the ``pattern`` in two colours, which may be similar, with some dirt."""
    one, other = colour(rng, low, high), colour(rng, low, high)
    if rng.random() < 0.4:
        other = one * rng.uniform(0.4, 0.9)
    image = one + (other - one) * pattern[..., None]
    dirt = 1 - rng.uniform(0, 0.35) * noise(rng, 1.3)[..., None]
    return np.clip(image * dirt, 0.01, 0.9)


def random_picture(rng: np.random.Generator, names=tuple(PATTERNS), low: float = 0.06, high: float = 0.8) -> np.ndarray:
    return coloured(rng, PATTERNS[str(rng.choice(names))](rng), low, high)


def leaf() -> np.ndarray:
    """(H, W) opacity of a leaf: a pointed oval."""
    y, x = np.mgrid[0:64, 0:64] / 31.5 - 1
    return (np.abs(x) < 0.75 * np.cos(y * np.pi / 2) ** 0.8).astype(float)


def sky(rng: np.random.Generator) -> np.ndarray:
    """A latitude-longitude environment, (128, 256, 3): clear, cloudy, evening, or a studio with soft boxes."""
    height = SIZE // 2
    elevation = (np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi)[:, None]
    azimuth = ((np.arange(2 * height) + 0.5) / height * np.pi)[None]
    up = np.clip(np.sin(elevation), 0, 1)[..., None]
    ground = colour(rng, 0.05, 0.3)
    if rng.random() < 0.25:
        image = np.full((height, 2 * height, 3), rng.uniform(0.02, 0.3))
        for _ in range(rng.integers(2, 6)):
            row, column = rng.integers(0, height // 2), rng.integers(0, 2 * height - 30)
            tall, wide = rng.integers(4, 30, 2)
            image[row : row + tall, column : column + wide] = rng.uniform(3, 20) * colour(rng, 0.7, 1)
        return image.astype(np.float32)
    evening = rng.random() < 0.3
    zenith = np.array([0.15, 0.3, 0.75]) * rng.uniform(0.3, 1.2)
    horizon = np.array([1.0, 0.5, 0.25]) if evening else np.array([0.85, 0.85, 0.85])
    image = (horizon + (zenith - horizon) * up**0.5) * np.ones((1, 2 * height, 1))
    clouds = np.clip(noise(rng, 1.5)[:height] * 3 - rng.uniform(1, 2), 0, 1)
    image += rng.uniform(0, 1) * clouds[..., None] * (0.3 + up)
    image[elevation[:, 0] < 0] = ground
    if rng.random() < 0.75:
        height_of_sun = rng.uniform(0.05, 0.35) if evening else rng.uniform(0.3, 1.3)
        direction = rng.uniform(0, 2 * np.pi)
        away = np.cos(azimuth - direction)
        cosine = np.sin(elevation) * np.sin(height_of_sun) + np.cos(elevation) * np.cos(height_of_sun) * away
        radius = rng.uniform(0.05, 0.2)
        disk = cosine > np.cos(radius)
        power = rng.uniform(0.3, 3) / (np.pi * radius**2)
        image[disk] += power * (np.array([1, 0.6, 0.3]) if evening else np.array([1, 0.95, 0.85]))
    return image.astype(np.float32)


def write_pfm(path: Path, image: np.ndarray) -> None:
    """Writes (H, W, 3) float32 as a PFM, with rows from the bottom up, as the format requires."""
    height, width = image.shape[:2]
    path.write_bytes(f"PF\n{width} {height}\n-1.0\n".encode() + np.ascontiguousarray(image[::-1], "<f4").tobytes())
