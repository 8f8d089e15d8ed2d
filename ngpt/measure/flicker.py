"""Flicker: how the error of a shot (a frame sequence) changes from frame to frame."""

from collections.abc import Sequence

import numpy as np

from ngpt.errors import NgptError
from ngpt.measure.metrics import EPSILON, trimmed_mean
from ngpt.sequence.warp import warped


def flicker_maps(
    images: Sequence[np.ndarray], references: Sequence[np.ndarray], motions: Sequence[np.ndarray | None]
) -> list[np.ndarray]:
    """Maps (H, W, 3) of (d - d_r)² / (m + 1e-3), one for each frame but the first. Unknown values are NaN.

    d = x_t(p) - x_{t-1}(p + motion) is the change of the images x along the motion, d_r is the same change of the
    references r, and m is the mean of r² in both frames. ``motions`` has an entry (H, W, 2) for each frame; the first
    one is not used. None and NaN mean unknown motion. Changes that the reference has, too, are not flicker, such as a
    moving shadow or a reflection. Raises NgptError for lists of different lengths, or of fewer than two frames.
    """
    if not len(images) == len(references) == len(motions) or len(images) < 2:
        raise NgptError(
            f"flicker of {len(images)} images, {len(references)} references and {len(motions)} motions: it takes two "
            "frames or more, and as many of each"
        )
    errors = [np.asarray(image, np.float64) - reference for image, reference in zip(images, references, strict=True)]
    return _changes(errors, references, motions)


def change_maps(images: Sequence[np.ndarray], motions: Sequence[np.ndarray | None]) -> list[np.ndarray]:
    """Maps (H, W, 3) of d² / (m + 1e-3), one for each frame but the first. Unknown values are NaN.

    d = x_t(p) - x_{t-1}(p + motion) is the change of the images x along the motion, m the mean of x² in both frames.
    The maps hold every change: flicker and moving light. Where a frame has no motion (None), nothing moves.
    """
    still = np.zeros((*np.shape(images[0])[:2], 2)) if len(images) else None
    images = [np.asarray(image, np.float64) for image in images]
    return _changes(images, images, [still if motion is None else motion for motion in motions])


def _changes(
    values: Sequence[np.ndarray], levels: Sequence[np.ndarray], motions: Sequence[np.ndarray | None]
) -> list[np.ndarray]:
    """Squared changes of ``values`` along the motion, over the mean of squared ``levels`` in both frames."""
    maps = []
    squares = [np.square(level, dtype=np.float64) for level in levels]
    pairs = zip(values, values[1:], squares, squares[1:], motions[1:], strict=False)
    for last, value, square_before, square, motion in pairs:
        if motion is None:
            maps.append(np.full(value.shape, np.nan))
            continue
        before, found = warped(last, motion)
        # The mean of both frames, because a pixel that changes from a lamp to the dark should not dominate all others.
        level = (square + warped(square_before, motion)[0]) / 2
        relative = np.square(value - before) / (level + EPSILON)
        maps.append(np.where(found[..., None], relative, np.nan))
    return maps


def flicker(
    images: Sequence[np.ndarray], references: Sequence[np.ndarray], motions: Sequence[np.ndarray | None]
) -> float:
    """The mean of ``flicker_maps`` over frames and known pixels, without the worst 0.1 % of each frame.

    It is 0 if the error of a shot moves with the surfaces, and twice the mean relMSE if the errors of successive frames
    are independent. NaN if no pixel is known.
    """
    values = []
    for image in flicker_maps(images, references, motions):
        known = image[np.isfinite(image).all(axis=-1)]
        if len(known):
            values.append(trimmed_mean(known, known, 0.001))
    return float(np.mean(values)) if values else float("nan")
