"""The rows of section 5 of the survey: reconstructions that are methods of ours, and those that live here alone."""

from collections.abc import Sequence
from dataclasses import replace
from unittest.mock import patch

import numpy as np

from ngpt.classical.bases import CLASSICAL
from ngpt.denoisers import nfor
from ngpt.methods import METHODS, Method, reconstruct
from ngpt.repair import Repaired
from ngpt.stack import GradientStack
from ngpt.studies.bcd import collaborative
from ngpt.studies.norms import irls, wl1
from ngpt.studies.patches import patches
from ngpt.studies.resampling import resampled

_GRADIENTS = ("primal", "dx", "dy")
_VARIANCES = (*_GRADIENTS, "primal_var", "dx_var", "dy_var")
_FEATURES = ("albedo", "normal", "depth")


def _bcd(data: Repaired) -> np.ndarray:
    assert data.noise is not None
    return collaborative(data.image, data.noise)


def _bcd_of_gradients(method: str):
    """The primal stays; a classical method solves for it and the denoised differences."""

    def solve(data: Repaired) -> np.ndarray:
        dx, dy = (collaborative(d, v) for d, v in zip((data.dx, data.dy), data.variances[1:], strict=True))
        return CLASSICAL[method](replace(data, dx=dx, dy=dy))

    return solve


def _nfor_with(method: str, features: Sequence[str]):
    """NFOR of the primal, to which a reconstruction from gradients is one feature more."""

    def solve(data: Repaired) -> np.ndarray:
        assert data.noise is not None
        guides = [data.features[name] for name in features]
        return nfor.nfor(data.image, data.noise, [*guides, CLASSICAL[method](data)])

    return solve


ROWS = {
    "irls": Method("least norms by reweighting", _GRADIENTS, irls, {}),
    "wl1": Method("least norms in units of standard deviations", _VARIANCES, wl1, {}),
    "patches": Method("wl2 and windows that are linear in features", (*_VARIANCES, *_FEATURES), patches, {}),
    "nfor-wcv": Method("nfor, wcv one feature more", (*_VARIANCES, *_FEATURES), _nfor_with("wcv", _FEATURES), {}),
    "nfor-l1": Method("nfor, l1 one feature more", (*_VARIANCES, *_FEATURES), _nfor_with("l1", _FEATURES), {}),
    "nfor-wcv-alone": Method("nfor, wcv its only feature", _VARIANCES, _nfor_with("wcv", ()), {}),
    "bcd": Method("collaborative denoising of the primal", ("primal", "primal_var"), _bcd, {}),
    "bcd-wl2": Method("wl2 of denoised gradients", _VARIANCES, _bcd_of_gradients("wl2"), {}),
    "bcd-l1": Method("l1 of denoised gradients", _VARIANCES, _bcd_of_gradients("l1"), {}),
}

# Of runs drawn anew, and with what method
RESAMPLED = {f"resampled {name}": name for name in ("l2", "l1", "wcv", "nfor-l1", "nfor-wcv")}
OURS = ("primal", "l2", "l1", "cv", "wcv", "wl2", "nfor", "oidn", "ngpt-fast", "ngpt-combine")


def usable(names: Sequence[str] = (*OURS, *ROWS, *RESAMPLED)) -> list[str]:
    """Those of the names whose packages are installed here."""
    return [name for name in names if name not in METHODS or not METHODS[name].missing()]


def image_of(name: str, merged: GradientStack, runs: Sequence[GradientStack]) -> np.ndarray:
    """The image of a row, (H, W, 3) float32; ``merged`` is the stack of all ``runs``."""
    if name in RESAMPLED:
        return image_of(RESAMPLED[name], resampled(runs, merged), runs)
    if name not in ROWS:
        return reconstruct(merged, name).image
    with patch.dict(METHODS, ROWS):
        return reconstruct(merged, name).image
