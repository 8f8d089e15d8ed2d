"""The reconstruction methods: one registry, one way to call them.

A new method is one more entry in ``METHODS``; the command line, the reports and the tables find it there.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ngpt import poisson
from ngpt.errors import NgptError
from ngpt.repair import Repaired, repair
from ngpt.stack import GradientStack


@dataclass(frozen=True)
class Method:
    """How to call one reconstruction.

    ``summary``  one line for the user
    ``needs``    layers of the stack it cannot do without
    ``run``      Repaired, options -> (H, W, 3) float32 without direct emission
    ``options``  the options it takes, with their defaults
    """

    summary: str
    needs: tuple[str, ...]
    run: Callable[..., np.ndarray]
    options: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """A reconstruction and what is worth knowing about it.

    ``image``      (H, W, 3) float32, scene-linear, in the units of the stack's primal
    ``method``     the method that made it ("auto" resolved)
    ``seconds``    wall time of repair and reconstruction, without file access
    ``repaired``   pixels of the primal that were not finite and were replaced
    ``untrusted``  differences that were left out because they, or a pixel of theirs, were not finite
    """

    image: np.ndarray
    method: str
    seconds: float
    repaired: int
    untrusted: int


def _primal(data: Repaired) -> np.ndarray:
    return data.image


def _l2(data: Repaired, alpha: float) -> np.ndarray:
    return poisson.l2(data.image, data.dx, data.dy, alpha, data.trusted)


def _l1(data: Repaired, alpha: float) -> np.ndarray:
    return poisson.l1(data.image, data.dx, data.dy, alpha, data.trusted)


_ALPHA = {"alpha": poisson.DEFAULT_ALPHA}

METHODS = {
    "primal": Method("the Monte Carlo estimate as it is", ("primal",), _primal, {}),
    "l2": Method("screened Poisson, least squares: unbiased, fast", ("primal", "dx", "dy"), _l2, _ALPHA),
    "l1": Method("screened Poisson, least norms: robust to outliers", ("primal", "dx", "dy"), _l1, _ALPHA),
}


def choose(stack: GradientStack) -> str:
    """The method that ``auto`` stands for: the best of those the stack has the layers for."""
    return "l1" if "dx" in stack and "dy" in stack else "primal"


def reconstruct(stack: GradientStack, method: str = "auto", **options) -> Result:
    """Runs a method on a stack and says what it did.

    ``method`` is ``auto`` or a name in ``METHODS``; ``options`` are the method's own (``alpha`` for l2 and l1). Raises
    NgptError for an unknown method or option, missing layers, and a primal without any finite pixel.
    """
    start = time.perf_counter()
    name = choose(stack) if method == "auto" else method
    if name not in METHODS:
        raise NgptError(f"unknown method '{name}'; choose one of: auto, {', '.join(METHODS)}")
    entry = METHODS[name]
    for option in options:
        if option not in entry.options:
            raise NgptError(f"method '{name}' has no option '{option}'; it has: {', '.join(entry.options) or 'none'}")
    stack.require(*entry.needs, why=f"method '{name}'")
    data = repair(stack)
    # Extreme values may leave the range of float32 inside; what comes out is checked.
    with np.errstate(over="ignore", invalid="ignore"):
        image = entry.run(data, **(entry.options | options)) + data.direct
    lost = int(np.sum(~np.isfinite(image).all(axis=-1)))
    if lost:
        raise NgptError(
            f"{stack.path}: method '{name}' gave {lost} non-finite pixels; the largest input value is "
            f"{np.abs(data.image).max():.3g}: scale the stack down, or use another method"
        )
    return Result(
        np.ascontiguousarray(image, np.float32), name, time.perf_counter() - start, data.pixels, data.gradients
    )


def denoise(stack: GradientStack, method: str = "auto", **options) -> np.ndarray:
    """The reconstruction of a stack, (H, W, 3) float32, scene-linear: ``reconstruct(stack, method).image``."""
    return reconstruct(stack, method, **options).image
