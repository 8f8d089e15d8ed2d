"""Pictures of a report: scene-linear numbers in few bytes, each within a stated relative error.

A value v, exposed so that middle grey is near 0.18, becomes the whole number nearest
sgn(v) · steps · log2(1 + |v| / TOE). At most half a step is lost: |stored - v| / (|v| + TOE) is up to
2^(0.5 / steps) - 1, which is 0.0014 at 256 steps per stop, 0.029 at 12, and 0.09 at 4. The other steps are lossless:
the three numbers of a pixel are decorrelated by lifting (YCoCg-R, Malvar and Sullivan 2003), each row is predicted from
its neighbours (the median of LOCO-I, or the mean of four where noise prevails), and the residuals are deflated. All
arithmetic is modulo 2^16. ``report.html`` holds the decoder.
"""

import zlib

import numpy as np

TOE = 2.0**-6  # exposed radiance; codes are about linear below it and logarithmic above
LADDER = (256, 128, 64, 48, 32, 24, 16, 12, 8, 6, 4)  # steps per stop, finest first
MAX_CODE = 32000  # 125 stops above TOE at 256 steps per stop; larger values are clamped to it
INFINITE, UNDEFINED = 32001, 32002


def codes(image: np.ndarray, steps: int) -> np.ndarray:
    """(..., 3) exposed floats -> int16; ±INFINITE and UNDEFINED stand for values that are not finite."""
    image = np.asarray(image, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        code = np.sign(image) * np.minimum(np.rint(steps * np.log2(1.0 + np.abs(image) / TOE)), MAX_CODE)
    code = np.where(np.isinf(image), np.copysign(INFINITE, image), code)
    return np.where(np.isnan(image), UNDEFINED, code).astype(np.int16)


def values(code: np.ndarray, steps: int) -> np.ndarray:
    """The inverse of :func:`codes`, float64."""
    size = np.abs(code.astype(np.float64))
    with np.errstate(over="ignore"):  # codes that stand for no finite number are replaced below
        out = np.sign(code) * TOE * (2.0 ** (np.minimum(size, MAX_CODE) / steps) - 1.0)
    out = np.where(size == INFINITE, np.copysign(np.inf, out), out)
    return np.where(code == UNDEFINED, np.nan, out)


def encode(image: np.ndarray, steps: int) -> bytes:
    """(H, W, 3) exposed floats -> deflated bytes, in this order:

    3 H bytes  the predictor of each row of Y, then of Cg and Co: 0 median, 1 mean
    nibbles    all residuals in zigzag code (0, -1, 1, -2, ...), two in a byte, the first one high; 15 marks a
               residual of 15 or more
    bytes      the low bytes of those larger residuals, then their high bytes
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
    """The two predictions of each number, int16. Above the first row all values are 0; beyond the sides the values of
    the row above continue."""
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
    """Steps per stop for each of the exposed ``images`` such that all of them, encoded, take about ``room`` bytes.

    The image that takes most room is made coarser first: it is the noisiest, and noise hides the loss best. Sizes are
    estimated from an eighth of the rows. If all images have the coarsest steps, the result may exceed ``room``.
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
    rows = np.arange(len(image)) % 64 < 8 if len(image) >= 256 else np.ones(len(image), bool)
    return len(encode(image[rows], steps)) * len(image) / rows.sum()
