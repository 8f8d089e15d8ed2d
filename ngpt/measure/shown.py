"""The metrics that a page shows with its pictures, and maps of SSIM and FLIP."""

import numpy as np

from ngpt.measure import perceptual
from ngpt.measure.flip import flip
from ngpt.measure.metrics import METRICS, scores

SHOWN = ("relMSE", "relMSE trimmed", "SMAPE", "PSNR", "SSIM", "FLIP")
_WITH_MAP = {"SSIM": perceptual.ssim, "FLIP": flip}


def available(height: int, width: int) -> tuple[list[str], dict[str, str]]:
    """(available, unavailable) metrics for images of this size, from SHOWN and from other packages.

    The second is a dict from names to reasons, in one line each.
    """
    names = (*SHOWN, *METRICS.load())
    lacks = {name: missing() for name in names if (missing := METRICS[name].missing)}
    if min(height, width) < 11:
        lacks["SSIM"] = f"SSIM needs images of 11x11 pixels, and these are {width}x{height}"
    return [name for name in names if not lacks.get(name)], {name: lack for name, lack in lacks.items() if lack}


def judge(names: list[str], image: np.ndarray, reference: np.ndarray) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Metrics of (H, W, 3) images by name, and maps (H, W) of FLIP and SSIM: 0 where equal, 1 where most different.

    Pixels that are not finite are treated as in ``ngpt.measure.metrics.scores``, which also raises the same errors.
    """
    values = scores([name for name in names if name not in _WITH_MAP], image, reference)
    maps = {}
    filled = [np.nan_to_num(i, nan=0.0, posinf=0.0, neginf=0.0) for i in (image, reference)]
    for name in names:
        if name in _WITH_MAP:
            values[name], found = _WITH_MAP[name](*filled)
            maps[name] = np.clip(1.0 - found if METRICS[name].better == "higher" else found, 0.0, 1.0)
    return {name: values[name] for name in names}, maps
