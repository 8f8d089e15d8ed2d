"""Previews of a running render: the noisy image, a quick reconstruction, and their standard errors."""

from dataclasses import dataclass, field

import numpy as np

from ngpt.api.uncertainty import reconstruct_with_error
from ngpt.image.display import ERROR_EPSILON, ERROR_RANGE, auto_exposure
from ngpt.methods import METHODS, reconstruct
from ngpt.report.content import ReportEntry, Scene
from ngpt.stack import GradientStack

_NOISY = "noisy"
# Quick methods with small errors, of which the first usable one runs. The first two take 50 and 75 ms on two cores, for
# 240x160 pixels.
_QUICK = ("oidn-fast", "wcv", "l2")
_LOW, _HIGH = np.log10(ERROR_RANGE)
_MEANING = "standard error relative to the light"
_MARKS = ["≤ 1 %", "3.2 %", "10 %", "32 %", "≥ 100 %"]


@dataclass
class Preview:
    """The images and maps of a preview.

    ``images``  name -> (H, W, 3) scene-linear, the noisy image first
    ``maps``    name of an image -> name of a map -> (H, W) from 0 to 1
    ``most``    the largest number of samples of a pixel; 0 if all pixels have the same number
    """

    images: dict[str, np.ndarray]
    maps: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    most: float = 0.0

    def scene(self, name: str, caption: str) -> Scene:
        """The preview as a tab of the report."""
        entries = [ReportEntry(image, pixels, maps=self.maps.get(image, {})) for image, pixels in self.images.items()]
        share = [f"{self.most * part:.0f}" for part in (0, 0.25, 0.5, 0.75, 1)]
        meanings = {"std. error": (_MEANING, _MARKS), "samples": ("samples of the pixel", share)}
        return Scene(name, caption, None, entries, meanings=meanings)


def preview(stack: GradientStack) -> Preview:
    """The preview of a stack, with maps of the standard errors if it has variances."""
    usable = (n for n in _QUICK if all(layer in stack for layer in METHODS[n].needs) and not METHODS[n].missing())
    method = next(usable, "")
    light = stack["primal"]
    unit = np.square(light).mean(axis=-1) + ERROR_EPSILON * 4.0 ** -auto_exposure(light)
    found, maps = Preview({_NOISY: light}), {}
    if "primal_var" in stack:
        variances = [stack[name] for name in ("primal_var", "caustic_var") if name in stack]
        maps[_NOISY] = _place(np.sum(variances, axis=0), unit)
    if method:
        known = "primal_var" in stack and all(f"{d}_var" in stack for d in ("dx", "dy") if d in stack)
        result = (reconstruct_with_error if known else reconstruct)(stack, method)
        found.images[method] = result.image
        if result.error is not None:
            maps[method] = _place(np.square(result.error), unit)
    found.maps = {name: {"std. error": values} for name, values in maps.items()}
    if "samples" in stack:
        samples = stack["samples"][..., 0]
        found.most = float(samples.max())
        for name in found.images:
            found.maps.setdefault(name, {})["samples"] = samples / found.most
    return found


def _place(variance: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Divides variances (H, W, 3) by squared radiance (H, W), and returns positions (H, W) from 0 to 1 for a map."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip((np.log10(np.nan_to_num(variance).mean(axis=-1) / unit) - _LOW) / (_HIGH - _LOW), 0, 1)
