"""The pictures of a report survive their storage to the error that is stated."""

import zlib

import numpy as np
import pytest

from ngpt.report import pixelcodec


def decoded(data: bytes, height: int, width: int, steps: int) -> np.ndarray:
    """The inverse of encode, number by number, as the page does it; float64."""
    raw = np.frombuffer(zlib.decompress(data), np.uint8)
    rules, rest = raw[: 3 * height].reshape(3, height), raw[3 * height :].astype(int)
    count = 3 * height * width
    pairs, large = rest[: (count + 1) // 2], rest[(count + 1) // 2 :].reshape(2, -1)
    folded = np.stack([pairs >> 4, pairs & 15], axis=1).ravel()[:count]
    folded[folded == 15] = large[0] | large[1] << 8
    folded = folded.reshape(3, height, width)
    planes = np.zeros((3, height, width), np.int16)
    for plane, rule, residuals in zip(planes, rules, (folded >> 1) ^ -(folded & 1), strict=True):
        for y in range(height):
            for x in range(width):
                above, corner, other = (
                    int(plane[y - 1, np.clip(i, 0, width - 1)]) if y else 0 for i in (x, x - 1, x + 1)
                )
                left = int(plane[y, x - 1]) if x else above
                low, high = min(left, above), max(left, above)
                guess = low if corner >= high else high if corner <= low else left + above - corner
                if rule[y]:
                    guess = (left + above + corner + other + 2) >> 2
                plane[y, x] = np.array(guess + residuals[y, x]).astype(np.int16)
    light, leaf, orange = planes
    middle = light - (leaf >> 1)
    blue = middle - (orange >> 1)
    codes = np.stack([blue + orange, leaf + middle, blue], axis=2)
    size = np.abs(codes.astype(np.float64))
    with np.errstate(over="ignore"):  # codes of values that are not finite
        found = np.sign(codes) * pixelcodec.TOE * (2.0 ** (np.minimum(size, pixelcodec.MAX_CODE) / steps) - 1.0)
    found = np.where(size == pixelcodec.INFINITE, np.copysign(np.inf, codes), found)
    return np.where(codes == pixelcodec.UNDEFINED, np.nan, found)


@pytest.mark.parametrize("steps", [pixelcodec.LADDER[0], 12, pixelcodec.LADDER[-1]])
def test_no_pixel_is_off_by_more_than_is_stated(steps):
    rng = np.random.default_rng(1)
    image = rng.normal(size=(21, 31, 3)) * 2.0 ** rng.uniform(-20, 40, (21, 31, 1))
    image[7:] = np.linspace(0, 1, 31)[:, None]  # rows for the other predictor
    image[0, :2] = [[np.nan, np.inf, -np.inf], [1e30, -1e30, 0.0]]
    found = decoded(pixelcodec.encode(image, steps), 21, 31, steps)
    assert np.isnan(found[0, 0, 0]) and found[0, 0, 1] == np.inf and found[0, 0, 2] == -np.inf
    found, image = found[np.isfinite(image)], image[np.isfinite(image)]
    error = np.abs(found - image) / (np.abs(image) + pixelcodec.TOE)
    worst = 2 ** (0.5 / steps) - 1
    assert 0.8 * worst < error.max() <= worst * (1 + 1e-9)
