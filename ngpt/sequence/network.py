"""A network that weights history separately at each scale of the difference between history and this frame's result.

    y = x + t Σ_s b_s D_s,        b_s = min(MOST sigmoid(logit(b / t MOST) + C tanh(c_s / C)), f)

D_s are the bands of h - x, fine to coarse, whose sum is h - x. b and t are share and trust of the rules, f is the b of
the variances (``ngpt.sequence.evidence``), and c_s is the output of the network for ``Blend.inputs``. If c_s = 0, y is
the result of the rules. The network corrects the rules by at most C, so clear evidence still decides, as after a change
of all light. Changes of light have coarse scales, moving reflections have fine ones, and noise that is left in x has
both. Whatever the network predicts, y is between x and h at each scale, and a newly visible surface gets nothing from
the surface that hid it. The network was trained on frames of moving shots, with histories that it made itself
(``ngpt.training.temporal``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np

from ngpt.errors import NgptError
from ngpt.network import run_onnx, tiles
from ngpt.network.describe import FRAMES
from ngpt.network.exposure import statistics
from ngpt.network.shipped import WEIGHTS as FOLDER
from ngpt.sequence.evidence import Evidence
from ngpt.system.late import ndimage

# (H, W, len(INPUTS)) float32 -> corrections (H, W, len(SCALES) + 1) float32.
Corrections = Callable[[np.ndarray], np.ndarray]

# Standard deviations, in pixels, of the windows that separate the bands.
SCALES = (1.5, 5.0)
BANDS = len(SCALES) + 1
# The largest weight of history; and the least distance of the rules' weight, divided by it, from 0 and 1, so that its
# logit is finite.
MOST, LEAST = 0.97, 0.003
# C: the largest correction by the network, in the logarithm of odds.
LARGEST = 1.5
INPUTS = (
    *("change r", "change g", "change b", "rest r", "rest g", "rest b", "light", "noise", "change over noise"),
    *(f"band {s} over noise" for s in range(BANDS)),
    *("share", "first", "trust", "best", "weight", "speed", "albedo", "facing"),
)
WEIGHTS = FOLDER / "temporal.onnx"
# The number of pixels of a strip that the network processes at a time; each needs about 1 KB.
STRIP = 1 << 20


@dataclass(frozen=True)
class Blend:
    """A frame and its history.

    ``now``, ``history``, ``primal``  x, h and the noisy primal, (H, W, 3)
    ``evidence``, ``trust``, ``first``  the evidence of the rules, the agreement of features, and the b of the variances
    ``speed``     (H, W), the motion in image widths per frame
    ``features``  the features of the frame, by name
    """

    now: np.ndarray
    history: np.ndarray
    primal: np.ndarray
    evidence: Evidence
    trust: np.ndarray
    first: np.ndarray
    speed: np.ndarray
    features: Mapping[str, np.ndarray]

    @cached_property
    def bands(self) -> np.ndarray:
        """D_s, (BANDS, H, W, 3), finest first. Coarse bands are averages of trusted pixels only."""
        lows = [self.history - self.now]
        trusted = self.trust[..., None] * lows[0]
        for scale in SCALES:
            weight = ndimage.gaussian_filter(self.trust, scale, mode="nearest", truncate=2.5)
            low = ndimage.gaussian_filter(trusted, (scale, scale, 0), mode="nearest", truncate=2.5)
            lows.append(low / np.maximum(weight, 1e-3)[..., None])
        return np.stack([*(one - other for one, other in pairwise(lows)), lows[-1]])

    @property
    def prior(self) -> np.ndarray:
        """logit(b / t MOST), (H, W)."""
        share = self.evidence.share / np.maximum(self.trust, 1e-6) / MOST
        share = np.clip(share, LEAST, 1 - LEAST)
        return np.log(share / (1 - share)).astype(np.float32)

    def by(self, corrections: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """y (H, W, 3) and b (H, W) for corrections (H, W, BANDS); b is the mean of b_s, weighted by energy."""
        with np.errstate(over="ignore"):
            shares = MOST / (1 + np.exp(-(self.prior[..., None] + LARGEST * np.tanh(corrections / LARGEST))))
        shares = (self.trust[..., None] * np.minimum(shares, self.first[..., None])).astype(np.float32)
        image = self.now + np.einsum("hws,shwc->hwc", shares, self.bands)
        energy = np.square(self.bands).mean(axis=-1).transpose(1, 2, 0)
        energy = ndimage.gaussian_filter(energy, (2, 2, 0), mode="nearest") + 1e-6 * energy.mean() + 1e-30
        b = (shares * energy).sum(axis=-1) / energy.sum(axis=-1)
        return image, b.astype(np.float32)

    def inputs(self) -> np.ndarray:
        """The inputs of the network, (H, W, len(INPUTS)) float32; the same at any exposure."""
        scale = statistics({"primal": self.primal})[0]
        deviation = np.sqrt(self.evidence.noise)
        log_now, log_then = (np.log1p(np.maximum(image / scale, 0)) for image in (self.now, self.history))
        change = 20 * self.trust[..., None] * (log_then - log_now)
        change = np.sign(change) * np.log1p(np.abs(change))
        noise = deviation.mean(axis=-1) / (scale + np.abs(self.now).mean(axis=-1))
        over = np.sqrt(np.square((self.history - self.now) / deviation).mean(axis=-1)) * self.trust
        coarse = np.sqrt(np.square(self.bands / deviation).mean(axis=-1)) * self.trust
        albedo, normal = self.features.get("albedo"), self.features.get("normal")
        none = np.zeros(self.trust.shape)
        channels = [
            *np.moveaxis(change, -1, 0),
            *np.moveaxis(self.evidence.rest / (4 * deviation), -1, 0),
            log_now.mean(axis=-1),
            np.log1p(100 * noise) / 4,
            np.log1p(4 * over),
            *np.log1p(4 * coarse),
            self.evidence.share,
            self.first,
            self.trust,
            np.clip(self.evidence.best, -1, 2),
            self.evidence.weight,
            np.log1p(100 * self.speed),
            none if albedo is None else np.clip(albedo, 0, 1).mean(axis=-1),
            none if normal is None else normal[..., 2],
        ]
        return np.stack(channels, axis=-1).astype(np.float32)


class CorrectionNetwork:
    """The network in a file of ``ngpt.export.temporal``, as ``Corrections``.

    Raises NgptError for other files, and for networks with other inputs.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        session = run_onnx.session(self.path, "cpu", 0)
        metadata = session.get_modelmeta().custom_metadata_map
        if metadata.get(FRAMES) != ", ".join(INPUTS):
            raise NgptError(f"{path}: is no network that blends frames, or of another version of ngpt; export it anew")
        try:
            self.alignment, self.overlap = (int(metadata[f"ngpt.{name}"]) for name in ("alignment", "overlap"))
        except (KeyError, ValueError) as error:
            raise NgptError(f"{path}: its metadata {error} is missing, or no whole number; export it anew") from error
        self.types, self.output = run_onnx.floats(session, self.path)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """The corrections, computed in strips of rows; the height of the strips does not change the result."""
        height, width = inputs.shape[:2]
        padded = np.pad(inputs, [(0, -height % self.alignment), (0, -width % self.alignment), (0, 0)], mode="edge")
        rows = max(STRIP // padded.shape[1] // self.alignment, 1) * self.alignment
        result = np.empty((*padded.shape[:2], BANDS), np.float32)
        session = run_onnx.session(self.path, "cpu", 0)
        for strip, around in tiles.spans(len(padded), rows, self.overlap):
            given: np.ndarray = run_onnx.planes(padded[around])[None].astype(self.types["inputs"], copy=False)
            (made,) = session.run([self.output], {"inputs": given})
            result[strip] = np.moveaxis(made[0, :, tiles.within(strip, around)], 0, -1)
        return result[:height, :width]


def shipped() -> CorrectionNetwork | None:
    """The network that comes with ngpt; None without ONNX Runtime."""
    return CorrectionNetwork(WEIGHTS) if find_spec("onnxruntime") is not None and WEIGHTS.is_file() else None
