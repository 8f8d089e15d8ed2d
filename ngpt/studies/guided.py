"""Methods made of two: denoised gradients before a classical method, and a reconstruction as one feature more of NFOR.

[survey, section 5; the second is of Back, Yoon and Moon 2018, "Feature generation for adaptive gradient-domain path
tracing"]
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ngpt.classical.bases import CLASSICAL
from ngpt.denoisers import nfor
from ngpt.repair import Repaired
from ngpt.studies.bcd import collaborative


def of_denoised_gradients(method: str) -> Callable[[Repaired], np.ndarray]:
    """The classical method of the primal as it is, and of differences that ``collaborative`` has denoised."""

    def solve(data: Repaired) -> np.ndarray:
        dx, dy = (collaborative(d, v) for d, v in zip((data.dx, data.dy), data.variances[1:], strict=True))
        return CLASSICAL[method](replace(data, dx=dx, dy=dy))

    return solve


def nfor_with(method: str, features: Sequence[str]) -> Callable[[Repaired], np.ndarray]:
    """NFOR of the primal, by these features and the image of a classical method."""

    def solve(data: Repaired) -> np.ndarray:
        assert data.noise is not None
        guides = [data.features[name] for name in features]
        return nfor.nfor(data.image, data.noise, [*guides, CLASSICAL[method](data)])

    return solve
