"""The classical reconstructions of a repaired stack, by name, with their layers and options.

The solvers in this package take only arrays. This module calls them with the arrays of a stack.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ngpt.classical import controlvariates, poisson, weighted
from ngpt.classical.energy import keep_energy
from ngpt.classical.variances import auto_alpha
from ngpt.options import Option
from ngpt.repair import Repaired


@dataclass(frozen=True)
class Classical:
    """A classical reconstruction.

    ``needs``    the layers that the stack must hold
    ``solve``    (Repaired, options) -> (H, W, 3) float32 without direct emission
    ``options``  its options, by name
    """

    needs: tuple[str, ...]
    solve: Callable[..., np.ndarray]
    options: dict[str, Option]

    def __call__(self, data: Repaired) -> np.ndarray:
        """The reconstruction with default options."""
        return self.solve(data, **{name: option.default for name, option in self.options.items()})


def _l2(data: Repaired, alpha: float | str) -> np.ndarray:
    return poisson.l2(data.image, data.dx, data.dy, _alpha(data, alpha, norm=2), data.trusted)


def _l1(data: Repaired, alpha: float | str) -> np.ndarray:
    return poisson.l1(data.image, data.dx, data.dy, _alpha(data, alpha, norm=1), data.trusted)


def _cv(data: Repaired) -> np.ndarray:
    return controlvariates.cv(data.image, data.dx, data.dy, data.trusted)


def _with_variances(solver: Callable[..., np.ndarray], data: Repaired) -> np.ndarray:
    return solver(data.image, data.dx, data.dy, *data.variances, data.trusted)


def _keeping_energy(solver: Callable[..., np.ndarray], data: Repaired) -> np.ndarray:
    return keep_energy(_with_variances(solver, data), data.image)


def _alpha(data: Repaired, alpha: float | str, norm: int) -> float:
    """``alpha`` as a number: "auto" follows from the variances; without variances it is the fixed default."""
    if not isinstance(alpha, str):
        return alpha
    if data.variances is None:
        return poisson.DEFAULT_ALPHA
    primal_var, dx_var, dy_var = data.variances
    return auto_alpha(primal_var, dx_var, dy_var, norm)


_GRADIENTS = ("primal", "dx", "dy")
_ALL = (*_GRADIENTS, "primal_var", "dx_var", "dy_var")


def weight_of_primal(default: float | str) -> Option:
    meaning = "weight of the primal image beside the gradients; auto: by the variances"
    return Option(default, meaning, choices=("auto",), range=(1e-15, 1e15))


CLASSICAL = {
    # "auto" halves the error of l2. For l1, it is no better than the fixed number.
    "l2": Classical(_GRADIENTS, _l2, {"alpha": weight_of_primal("auto")}),
    "l1": Classical(_GRADIENTS, _l1, {"alpha": weight_of_primal(poisson.DEFAULT_ALPHA)}),
    "cv": Classical(_GRADIENTS, _cv, {}),
    "wcv": Classical(_ALL, partial(_keeping_energy, controlvariates.wcv), {}),
    "wl2": Classical(_ALL, partial(_keeping_energy, weighted.wl2), {}),
}

# The methods that a network can start from, which take less time than the network. Here, wcv does not restore its
# energy, for which a tile would need pixels outside of it.
BASES = {
    "l2": CLASSICAL["l2"],
    "cv": CLASSICAL["cv"],
    "wcv": Classical(_ALL, partial(_with_variances, controlvariates.wcv), {}),
}
