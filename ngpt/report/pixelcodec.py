"""Stores the pictures of a report: scene-linear numbers in few bytes, each within a known relative error.

A value v, exposed so that middle grey is near 0.18, is rounded to the whole number nearest
sgn(v) · steps · log2(1 + |v| / TOE). The error |stored - v| / (|v| + TOE) is at most 2^(0.5 / steps) - 1, which is
0.0014 at 256 steps per stop, 0.029 at 12, and 0.09 at 4. All that follows is lossless: the three numbers of a pixel are
decorrelated by lifting (YCoCg-R, Malvar and Sullivan 2003), each number is predicted from its neighbours (by the median
of LOCO-I, or by the mean of four in noisy rows), and the residuals are deflated. All arithmetic is modulo 2^16.
``report.html`` has the decoder.
"""

import zlib

import numpy as np

TOE = 2.0**-6  # exposed radiance, below which codes are about linear, and above which they are logarithmic
LADDER = (256, 128, 64, 48, 32, 24, 16, 12, 8, 6, 4)  # steps per stop, finest first
MAX_CODE = 32000  # 125 stops above TOE at 256 steps per stop; larger values are clamped to it
INFINITE, UNDEFINED = 32001, 32002


def codes(image: np.ndarray, steps: int) -> np.ndarray:
    """Exposed floats (..., 3) as int16; ±INFINITE and UNDEFINED stand for values that are not finite."""
    image = np.asarray(image, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        code = np.sign(image) * np.minimum(np.rint(steps * np.log2(1.0 + np.abs(image) / TOE)), MAX_CODE)
    code = np.where(np.isinf(image), np.copysign(INFINITE, image), code)
    return np.where(np.isnan(image), UNDEFINED, code).astype(np.int16)


def encode(image: np.ndarray, steps: int) -> bytes:
    """Exposed floats (H, W, 3) as deflated bytes, in this order:

    3 H bytes  the predictor of each row of Y, then of Cg and Co: 0 median, 1 mean
    nibbles    all residuals in zigzag code (0, -1, 1, -2, ...), two in a byte, the first one in its high half; 15
               stands for 15 or more
    bytes      the low bytes of the residuals of 15 or more, then their high bytes
    """
    red, green, blue = np.moveaxis(codes(image, steps), 2, 0)
    orange = red - blue  # int16 wraps
    middle = blue + (orange >> 1)
    leaf = green - middle
    residuals, rules = [], []
    for plane in (middle + (leaf >> 1), leaf, orange):
        candidates = np.stack([plane - guess for guess in _guesses(plane)])
        rule = np.abs(candidates.astype(np.int32)).sum(axis=2).argmin(axis=0)
        residuals.append(np.take_along_axis(candidates, rule[None, :, None], axis=0)[0])
        rules.append(rule.astype(np.uint8))
    folded = np.stack(residuals)
    folded = ((folded << 1) ^ (folded >> 15)).view(np.uint16).ravel()
    nibbles = np.minimum(np.pad(folded, (0, folded.size % 2)), 15).astype(np.uint8)
    large = folded[folded >= 15]
    packer = zlib.compressobj(6, zlib.DEFLATED, 15, 9, zlib.Z_FILTERED)
    parts = (np.stack(rules), nibbles[0::2] << 4 | nibbles[1::2], large & 255, large >> 8)
    body = b"".join(part.astype(np.uint8).tobytes() for part in parts)
    return packer.compress(body) + packer.flush()


def _guesses(plane: np.ndarray) -> list[np.ndarray]:
    """Two predictions of each number, int16: one from the median of its neighbours, and one from their mean.

    Neighbours above the first row are 0; those beyond the sides are equal to the nearest number of the row above.
    """
    padded = np.pad(plane.astype(np.int32), ((1, 0), (1, 1)), mode="edge")
    padded[0] = 0
    above, corner, other = padded[:-1, 1:-1], padded[:-1, :-2], padded[:-1, 2:]
    left = padded[1:, :-2].copy()
    left[:, 0] = above[:, 0]
    low, high = np.minimum(left, above), np.maximum(left, above)
    median = np.where(corner >= high, low, np.where(corner <= low, high, left + above - corner))
    mean = (left + above + corner + other + 2) >> 2
    return [median.astype(np.int16), mean.astype(np.int16)]


def fitting_steps(images: list[np.ndarray], room: float) -> list[int]:
    """Steps per stop for each of the exposed ``images``, so that all of them, encoded, take about ``room`` bytes.

    The largest encoded image is made coarser first, because it is the noisiest, and noise hides the loss best. Sizes of
    large images are estimated from an eighth of the rows. If all images have the coarsest steps, the result may still
    exceed ``room``.
    """
    places = [0] * len(images)
    sizes = [_estimate(image, LADDER[0]) for image in images]
    while sum(sizes) > room:
        open_ones = [i for i, place in enumerate(places) if place + 1 < len(LADDER)]
        if not open_ones:
            break
        worst = max(open_ones, key=lambda i: sizes[i])
        places[worst] += 1
        sizes[worst] = _estimate(images[worst], LADDER[places[worst]])
    return [LADDER[place] for place in places]


def _estimate(image: np.ndarray, steps: int) -> float:
    """The size of an encoded image in bytes, from an eighth of its rows if it is large."""
    rows = np.arange(len(image)) % 64 < 8 if len(image) >= 256 else np.ones(len(image), bool)
    return len(encode(image[rows], steps)) * len(image) / rows.sum()
