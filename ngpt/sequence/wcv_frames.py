"""Control variates over frames: ``wcv`` with a third difference, in time along motion.

In a window of frames, each pixel becomes the weighted mean of estimates by its neighbours [``controlvariates``, survey
eq. 14 and 20 - 22]. These are pixels of its own image, its position in the frame before, and those pixels of the frame
after whose motion leads to it:

    W I_{t-1}(p) + dt(p)  estimates  I_t(p), with W the lookup of the image before at p + motion

W is bilinear (B) for the unknown image, and a Catmull-Rom spline (S) for a first guess G of it, which is computed once:
W I = B I + (S - B) G. The difference (S - B) G shows the possible error of W: ``INTERPOLATION`` times the largest of
its squares in 3x3 pixels is added to the variance of dt. So other frames have little weight at edges that move by parts
of a pixel. A newly visible surface needs no test, because dt holds the difference to the surface that hid it.

As in ``controlvariates``, weights are relative: a = f var I / (f var I + var dt), with f the factor by which n
iterations have lowered the variance of a pixel, and smoothed variances (``ngpt.classical.variances``).

Memory beyond the input: 190 bytes per pixel and frame in single precision. Time: see docs/use/shots.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ngpt.classical.controlvariates import schedule
from ngpt.classical.leastsquares import FLOAT32_RANGE, robust_mean
from ngpt.classical.variances import SHARED, relative, smoothed
from ngpt.sequence.warp import bilinear_taps, warped
from ngpt.system.late import ndimage, sparse

# The factor on the squared difference of two interpolations, which is added to the variance of dt. Of 3, 10 and 30,
# this factor has the least error in slow shots of the built-in scenes `diffuse` and `glossy`.
INTERPOLATION = 10
# A factor on the variance of dt, which is measured by few pairs and often misses rare light, mainly gloss and caustics.
# Of 1, 4 and 16, this factor has the least error over slow and fast shots of those scenes and `coffee`, at 2 pairs per
# pixel.
DOUBT = 4


@dataclass(frozen=True)
class Link:
    """The relation of a frame to the frame before: ``motion`` (H, W, 2), ``dt`` and ``dt_var`` (H, W, 3); NaN: unknown.

    ``shift`` is the position (x, y) of this frame's first pixel in the frame before.
    """

    motion: np.ndarray
    dt: np.ndarray
    dt_var: np.ndarray
    shift: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class WindowFrame:
    """One frame of a window, arrays (H, W, 3), all finite except the variances.

    ``image``      the light that dx and dy describe
    ``apart``      light that dx and dy exclude and dt includes; it is added to the image
    ``dx, dy``     the gradients
    ``variances``  the variances of image, dx and dy; NaN where unknown
    ``trusted``    (H, W) booleans for dx and dy: where they can be trusted; None: everywhere
    ``guess``      image + apart, reconstructed by any method
    ``link``       the relation to the frame before in the window; None without such a frame
    """

    image: np.ndarray
    apart: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    variances: tuple[np.ndarray, np.ndarray, np.ndarray]
    trusted: tuple[np.ndarray, np.ndarray] | None
    guess: np.ndarray
    link: Link | None


def wcv_frames(frames: Sequence[WindowFrame], sweeps: int | None = None) -> list[np.ndarray]:
    """The reconstruction of image + apart of each frame, (H, W, 3) float32; frames without links give ``wcv``."""
    total = [frame.image + frame.apart for frame in frames]
    dtype = np.float64 if _wide(total) else np.float32
    total = [image.astype(dtype) for image in total]
    stills = [_Still(frame, dtype) for frame in frames]
    level = float(np.mean([still.level for still in stills]))
    for still in stills:
        still.divide(level)
    steps = [
        None if i == 0 or (link := frame.link) is None else _Step(link, frame.guess, frames[i - 1].guess, level, dtype)
        for i, frame in enumerate(frames)
    ]
    # By dt, the corrections of a frame and the frame before should have this difference.
    rest = [
        None if step is None else step.offset - total[i] + step.before(total[i - 1]) for i, step in enumerate(steps)
    ]
    corrections = [np.zeros_like(image) for image in total]
    for factor, length in schedule()[:sweeps]:
        said = [still.swept(u, factor) for still, u in zip(stills, corrections, strict=True)]
        for i, step in enumerate(steps):
            if step is not None:
                e = corrections[i] - step.before(corrections[i - 1]) - rest[i]
                step.add(e, factor * stills[i].primal, factor * stills[i - 1].primal, said[i], said[i - 1])
        corrections = [u + length * change / weight for u, (change, weight) in zip(corrections, said, strict=True)]
    return [(image + u).astype(np.float32) for image, u in zip(total, corrections, strict=True)]


def _wide(images: Sequence[np.ndarray]) -> bool:
    """Whether the range of values exceeds single precision."""
    sizes = [np.abs(image) for image in images]
    typical = float(np.median(np.concatenate([size[size > 0] for size in sizes] + [np.zeros(1)])))
    return max(float(size.max()) for size in sizes) > FLOAT32_RANGE * typical


class _Still:
    """A frame without its neighbours.

    ``primal``  (H, W, 1), the relative variances of its pixels; ``x``, ``y`` are those of its differences
    """

    def __init__(self, frame: WindowFrame, dtype: type):
        p, x, y = frame.variances
        self.primal, self.x, self.y = smoothed(p), smoothed(x[:, :-1], True), smoothed(y[:-1], True)
        self.level, self.dtype = robust_mean(self.primal, self.x, self.y), dtype
        image: np.ndarray = frame.image.astype(dtype)
        self.dx = frame.dx[:, :-1] - (image[:, 1:] - image[:, :-1])
        self.dy = frame.dy[:-1] - (image[1:] - image[:-1])
        self.trusted = frame.trusted

    def divide(self, level: float) -> None:
        """Makes the variances relative to the variance level of the whole window."""
        self.primal, self.x, self.y = (
            (share * relative(v, level, np.float64))[..., None].astype(self.dtype)
            for share, v in ((1, self.primal), (SHARED, self.x), (SHARED, self.y))
        )
        if self.trusted is not None:
            self.x[~self.trusted[0][:, :-1]] = np.inf
            self.y[~self.trusted[1][:-1]] = np.inf

    def swept(self, u: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """The weighted sum of changes to u by neighbours in the image; and the sum of weights, with 1 for u itself."""
        own = factor * self.primal
        change, weight = np.zeros_like(u), np.ones_like(own)
        for here, there, r, v in (
            (np.s_[:, :-1], np.s_[:, 1:], self.dx, self.x),
            (np.s_[:-1], np.s_[1:], self.dy, self.y),
        ):
            e = u[there] - u[here] - r
            for side, sign in ((here, 1), (there, -1)):
                a = own[side] / (own[side] + v)
                change[side] += sign * a * e
                weight[side] += a
        return change, weight


class _Step:
    """The link from a frame to the one before, prepared for the iteration."""

    def __init__(self, link: Link, guess: np.ndarray, guess_before: np.ndarray, level: float, dtype: type):
        self.shape, self.shape_before = guess.shape, guess_before.shape
        height, width = guess_before.shape[:2]
        places, weights, found = bilinear_taps(link.motion, (height, width), link.shift)
        spline, _ = warped(guess_before, link.motion, sharp=True, shift=link.shift)
        linear, _ = warped(guess_before, link.motion, shift=link.shift)
        known = found & np.isfinite(link.dt).all(axis=-1) & np.isfinite(link.dt_var).all(axis=-1)
        apart: np.ndarray = np.where(known[..., None], spline - linear, 0).astype(dtype)
        noise = smoothed(np.where(known[..., None], link.dt_var, np.nan), True)
        wrong = ndimage.maximum_filter(np.square(apart, dtype=np.float64).sum(axis=-1), 3)
        doubtful = relative(DOUBT * noise + INTERPOLATION * wrong, level, np.float64)
        variance = np.where(known, doubtful, np.inf)
        self.offset: np.ndarray = np.where(known[..., None], link.dt + apart, 0).astype(dtype)
        self.variance: np.ndarray = variance[..., None].astype(dtype)
        self.known = known[..., None]
        # B as a matrix. By its transpose, each pixel gets the mean of the estimates by all pixels that look it up,
        # weighted by their inverse variances.
        rows = np.broadcast_to(np.arange(known.size), places.shape)
        taps = (weights * known.ravel()).astype(dtype)
        self.look = sparse.csr_matrix((taps.ravel(), (rows.ravel(), places.ravel())), (known.size, height * width))
        back = self.look.T.tocsr()
        precision: np.ndarray = np.where(known, 1 / variance, 0).reshape(-1, 1).astype(dtype)
        self.precision, total = precision, back @ precision
        self.cover = np.minimum(back @ self.known.reshape(-1, 1).astype(dtype), 1).reshape(height, width, 1)
        self.back, self.total = back, np.maximum(total, np.finfo(dtype).tiny)
        seen = np.maximum(back @ self.known.reshape(-1, 1).astype(dtype), np.finfo(dtype).tiny)
        self.variance_before = (seen / self.total).reshape(height, width, 1)

    def before(self, image: np.ndarray) -> np.ndarray:
        """B of an image of the frame before; 0 where unknown."""
        return (self.look @ image.reshape(-1, 3)).reshape(self.shape)

    def add(
        self,
        e: np.ndarray,
        own: np.ndarray,
        own_before: np.ndarray,
        said: tuple[np.ndarray, np.ndarray],
        said_before: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Adds the estimates of both frames for each other to the changes and weights of both.

        ``e`` is the difference between this frame and its estimate from the frame before. ``own`` and ``own_before``
        are the variances of both frames.
        """
        e = np.where(self.known, e, 0)
        a = own / (own + self.variance)
        said[0][...] -= a * e
        said[1][...] += a
        heard = ((self.back @ (self.precision * e.reshape(-1, 3))) / self.total).reshape(self.shape_before)
        a = self.cover * own_before / (own_before + self.variance_before)
        said_before[0][...] += a * heard
        said_before[1][...] += a
