"""Converts scene-linear floats to 8-bit sRGB colours (H, W, 3) to look at.

These colours must not be measured, because they are clamped and rounded. NaN is always magenta, so that it cannot be
mistaken for a colour.
"""

import math
from collections.abc import Callable

import numpy as np

from ngpt.errors import NgptError

MAGENTA = (255, 0, 255)
MIDDLE_GREY = 0.18  # the reflectance to which a light meter exposes the average scene
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709

ERROR_EPSILON = 1e-2  # keeps the relative error of black pixels finite; for images at automatic exposure
ERROR_RANGE = (1e-4, 1.0)  # relative squared errors at the ends of the heat table: 1 % and 100 %, squared

MOST_ASPECT = 16.0  # the largest aspect of pixels that makes sense

# "inferno" of Smith and van der Walt at nine even steps. Its lightness grows evenly, which serves colour-blind readers.
_INFERNO = ("000004", "210c4a", "57106e", "8a226a", "bc3754", "e45a31", "f98e09", "f9cb35", "fcffa4")
_DIVERGING = ("9ecbff", "2f7fd6", "777777", "d9772b", "ffd09a")  # negative blue, zero grey, positive orange


def to_srgb8(image: np.ndarray, exposure_stops: float = 0.0) -> np.ndarray:
    """Scene-linear (H, W, 3) as uint8 sRGB (IEC 61966-2-1), after multiplication by 2**exposure_stops.

    Negative values show as 0, a pixel with +Inf as white, a pixel with NaN as magenta.
    """
    return to_display8(image, encoded_srgb, exposure_stops)


def encoded_srgb(light: np.ndarray) -> np.ndarray:
    """Linear values of 0 or more as sRGB values from 0 to 1."""
    linear = np.minimum(light, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_display8(image: np.ndarray, transform: Callable[[np.ndarray], np.ndarray], stops: float) -> np.ndarray:
    """Like :func:`to_srgb8`, with another ``transform`` from light (H, W, 3) of 0 or more to display values."""
    image = _rgb(image)
    # Clamped before and after the gain, so that Inf and the largest floats cannot overflow into NaN.
    light = np.clip(np.nan_to_num(image, nan=0.0, posinf=1e30, neginf=0.0), 0.0, 1e30)
    values = np.clip(transform(np.minimum(light * 2.0**stops, 1e30)), 0.0, 1.0)
    out = np.floor(255.0 * values + 0.5).astype(np.uint8)
    out[np.isposinf(image).any(axis=2)] = 255
    out[np.isnan(image).any(axis=2)] = MAGENTA
    return out


def squared(image: np.ndarray, aspect: float) -> np.ndarray:
    """An image (H, W, C) with square pixels, from pixels whose width is ``aspect`` times their height.

    Pixels are repeated, so that the image only becomes larger.
    """
    if not (1 / MOST_ASPECT <= aspect <= MOST_ASPECT) or aspect == 1:
        return image
    axis, factor = (1, aspect) if aspect > 1 else (0, 1 / aspect)
    length = round(image.shape[axis] * factor)
    return image.take(((np.arange(length) + 0.5) / factor).astype(int), axis)


def auto_exposure(reference: np.ndarray) -> float:
    """The exposure, in stops, that brings the log-average luminance of (H, W, 3) to middle grey, 0.18.

    Only finite pixels count. Pixels 13 stops or more below the 99th percentile of the lit pixels count as background
    and are left out. Fireflies are clamped to that percentile. The exposure of a black image is 0.
    """
    with np.errstate(invalid="ignore"):  # Inf - Inf is NaN, which is left out below
        luminance = (_rgb(reference) @ LUMINANCE).ravel()
    lit = luminance[np.isfinite(luminance) & (luminance > 0.0)]
    if lit.size == 0:
        return 0.0
    bright = np.percentile(lit, 99.0)
    subject = lit[lit > bright * 2.0**-13]
    key = np.exp(np.mean(np.log(np.minimum(subject, bright))))
    return float(np.log2(MIDDLE_GREY / key))


def signed_map(gradient: np.ndarray) -> np.ndarray:
    """The colours of a gradient layer (H, W, 3): zero is grey, negative blue, positive orange.

    The colours show the mean over RGB, linearly up to the 99th percentile of the mean's magnitude.
    """
    value = _rgb(gradient).mean(axis=2)
    magnitude = np.abs(value[np.isfinite(value)])
    scale = np.percentile(magnitude, 99.0) if magnitude.size else 0.0
    if scale == 0.0:  # the layer is zero nearly everywhere
        scale = magnitude.max(initial=0.0) or 1.0
    return coloured(0.5 + 0.5 * value / scale, sign_table())


def layer_view(name: str, layer: np.ndarray) -> np.ndarray:
    """The colours (H, W, 3) uint8 of a layer of a stack, (H, W), (H, W, 1) or (H, W, 3), by its name.

    Gradients are shown as in :func:`signed_map`, normals as colours, depth up to its 99th percentile, light and
    variances at automatic exposure, and other layers as they are.
    """
    layer = np.atleast_3d(np.asarray(layer, dtype=np.float64))
    layer = np.broadcast_to(layer, (*layer.shape[:2], 3))
    if name in ("dx", "dy"):
        return signed_map(layer)
    if name == "normal":
        colour = np.rint(127.5 * (np.clip(np.nan_to_num(layer), -1.0, 1.0) + 1.0)).astype(np.uint8)
        return np.where(np.isnan(layer).any(axis=2, keepdims=True), np.array(MAGENTA, np.uint8), colour)
    if name == "depth":
        finite = layer[np.isfinite(layer)]
        layer = layer / ((np.percentile(finite, 99.0) if finite.size else 0.0) or 1.0)
    elif name in ("primal", "direct", "caustic", "diffuse", "specular") or name.endswith("_var"):
        return to_srgb8(layer, auto_exposure(layer))
    return to_srgb8(layer)


def thumbnail(picture: np.ndarray, width: int) -> np.ndarray:
    """Averages blocks of (H, W, 3) uint8 until the picture is at most ``width`` wide."""
    factor = math.ceil(picture.shape[1] / width)
    sides = [math.ceil(side / factor) for side in picture.shape[:2]]
    rest = [side * factor - old for side, old in zip(sides, picture.shape, strict=False)]
    padded = np.pad(picture, ((0, rest[0]), (0, rest[1]), (0, 0)), mode="edge").astype(np.float64)
    return np.rint(padded.reshape(sides[0], factor, sides[1], factor, 3).mean(axis=(1, 3))).astype(np.uint8)


def heat_table() -> np.ndarray:
    """Colours from black through red to pale yellow, (256, 3) uint8 sRGB."""
    return colour_table(_INFERNO, 256)


def sign_table() -> np.ndarray:
    """Colours from blue through grey to orange, (255, 3) uint8 sRGB. Their number is odd: the middle one is zero."""
    return colour_table(_DIVERGING, 255)


def colour_table(anchors: tuple[str, ...], size: int) -> np.ndarray:
    """Colours (size, 3) uint8: the anchors at even steps, with linear interpolation between them."""
    colours = np.array([list(bytes.fromhex(anchor)) for anchor in anchors], dtype=np.float64)
    place = np.linspace(0.0, len(anchors) - 1, size)
    table = [np.interp(place, np.arange(len(anchors)), channel) for channel in colours.T]
    return np.rint(np.stack(table, axis=1)).astype(np.uint8)


def coloured(place: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The colours at positions (H, W) in a table (N, 3). Positions are clamped to 0 and 1, its ends; NaN is magenta."""
    index = np.rint((len(table) - 1) * np.clip(np.nan_to_num(place, nan=0.0), 0.0, 1.0))
    out = table[index.astype(np.uint8)]
    out[np.isnan(place)] = MAGENTA
    return out


def _rgb(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise NgptError(f"display: needs a non-empty (H, W, 3) image, got {image.shape}")
    return image.astype(np.float64)
