"""Labelled pictures for the documentation: columns of tiles under headings, written as JPEG or PNG.

Needs Pillow, which comes with the extra "peers" (scikit-image).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ngpt.system.files import atomic_output

GAP, HEADING, LINE = 8, 22, 18  # pixels: between tiles, height of a heading, and of a smaller line under it
PAPER, INK, SOFT = (255, 255, 255), (20, 20, 20), (90, 90, 90)


def scaled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) uint8 at ``size`` = (width, height): averaged where it shrinks, its pixels shown where it grows."""
    grows = size[0] > image.shape[1]
    filter = Image.Resampling.NEAREST if grows else Image.Resampling.LANCZOS
    return np.asarray(Image.fromarray(image).resize(size, filter))


def columns(headings: Sequence[Sequence[str]], tiles: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """(H, W, 3) uint8: column i has the lines ``headings[i]``, the first one larger, above ``tiles[i]``.

    The tiles of a row have equal sizes, and so have the headings equal numbers of lines.
    """
    widths = [column[0].shape[1] for column in tiles]
    top = HEADING + LINE * (len(headings[0]) - 1) + GAP
    height = top + sum(tile.shape[0] + GAP for tile in tiles[0]) - GAP
    canvas = Image.new("RGB", (sum(widths) + GAP * (len(widths) - 1), height), PAPER)
    draw = ImageDraw.Draw(canvas)
    x = 0
    for lines, column, width in zip(headings, tiles, widths, strict=True):
        for i, text in enumerate(lines):
            font = ImageFont.load_default(19 if i == 0 else 15)
            draw.text((x, 0 if i == 0 else HEADING + LINE * (i - 1)), text, INK if i == 0 else SOFT, font)
        y = top
        for tile in column:
            canvas.paste(Image.fromarray(tile), (x, y))
            y += tile.shape[0] + GAP
        x += width + GAP
    return np.asarray(canvas)


def save(path: Path, image: np.ndarray) -> None:
    """Writes the picture; the suffix says how: .jpg for renderings, .png for drawings."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path, overwrite=True) as temporary:
        Image.fromarray(image).save(temporary, quality=88, optimize=True)
    print(f"{path}: {image.shape[1]}x{image.shape[0]}, {path.stat().st_size / 1000:.0f} kB")
