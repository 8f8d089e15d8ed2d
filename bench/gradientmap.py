"""A map of the gain by gradients: variance of independent differences over variance of gradients."""

from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

from ngpt.image.display import colour_table, coloured
from ngpt.image.png import encode_png
from ngpt.stack import GradientStack
from ngpt.system.writing import write_bytes

# Blue where gradients have less variance than differences of pixels, grey where as much, orange where more.
COLOURS = colour_table(("0b3a75", "2f7fd6", "777777", "d9772b", "ffe6c8")[::-1], 255)
RANGE = 6  # powers of two at either end
SCALE = 4  # of the picture
# 3x5 pixels a character, row by row.
_GLYPHS = {
    "1": "010110010010111",
    "2": "110001010100111",
    "4": "101101111001001",
    "6": "011100111101111",
    "/": "001001010100100",
}


def variances_of_differences(stack: GradientStack) -> tuple[np.ndarray, np.ndarray]:
    """Variance of the difference of neighbours as independent pixels, (H, W, 3) along x and along y.

    NaN where there is no neighbour, and where the camera sees a light in either.
    """
    dark = stack["direct"].sum(axis=-1) == 0
    values = np.where(dark[..., None], stack["primal_var"], np.nan)
    across, down = np.full((2, *values.shape), np.nan, np.float64)
    across[:, :-1] = values[:, :-1] + values[:, 1:]
    down[:-1] = values[:-1] + values[1:]
    return across, down


def log_ratio(stack: GradientStack) -> np.ndarray:
    """log2 of the ratio of variances for each pixel, (H, W), both directions and 3x3 pixels together; NaN: unknown."""
    independent, gradient = np.zeros((2, stack.height, stack.width))
    for name, variance in zip(("dx", "dy"), variances_of_differences(stack), strict=True):
        known = np.isfinite(variance) & np.isfinite(stack[f"{name}_var"])
        independent += np.where(known, variance, 0).sum(axis=-1)
        gradient += np.where(known, stack[f"{name}_var"], 0).sum(axis=-1)
    independent, gradient = (uniform_filter(np.minimum(v, 1e30), 3, mode="constant") for v in (independent, gradient))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log2(independent / gradient)


def write_map(path: Path, stack: GradientStack) -> None:
    """Writes the map with its legend below, as PNG. Magenta is unknown: a light, or no light at all."""
    picture = np.kron(_colours(log_ratio(stack)), np.ones((SCALE, SCALE, 1), np.uint8))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, encode_png(np.concatenate([picture, legend(picture.shape[1])])))


def legend(width: int) -> np.ndarray:
    """A bar of all colours with their ratios below, (height, width, 3) uint8."""
    margin = 24
    bar = np.full((48, width, 3), 255, np.uint8)
    values = np.interp(np.arange(width), [margin, width - margin], [-RANGE, RANGE])
    bar[6:22, margin : width - margin] = _colours(values[None, margin : width - margin])
    for power in range(-RANGE, RANGE + 1, 2):
        text = f"{2**power}" if power >= 0 else f"1/{2**-power}"
        centre = round(np.interp(power, [-RANGE, RANGE], [margin, width - margin]))
        ink = np.kron(np.hstack([_glyph(character) for character in text]), np.ones((2, 2), bool))
        left = min(max(centre - ink.shape[1] // 2, 0), width - ink.shape[1])
        bar[30 : 30 + ink.shape[0], left : left + ink.shape[1]][ink] = 0
        bar[22:27, min(centre, width - 1)] = 0
    return bar


def _glyph(character: str) -> np.ndarray:
    """(5, 4) booleans, a blank column at the end."""
    ink = np.array([bit == "1" for bit in _GLYPHS[character]]).reshape(5, 3)
    return np.pad(ink, ((0, 0), (0, 1)))


def _colours(values: np.ndarray) -> np.ndarray:
    return coloured((values + RANGE) / (2 * RANGE), COLOURS)
