"""The reconstruction methods: one registry, one way to call them.

A new method is one more entry in ``METHODS``; the command line, the reports and the tables find it there.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.classical import controlvariates, poisson, weighted
from ngpt.classical.variances import auto_alpha
from ngpt.denoisers import nfor, nlm, oidn
from ngpt.errors import NgptError
from ngpt.network import combine, run_onnx
from ngpt.repair import Repaired, repair
from ngpt.stack import GradientStack


@dataclass(frozen=True)
class Method:
    """How to call one reconstruction.

    ``summary``  one line for the user
    ``needs``    layers of the stack it cannot do without
    ``run``      Repaired, options -> (H, W, 3) float32 without direct emission
    ``options``  the options it takes, with their defaults
    ``missing``  why it cannot be used here ("" if it can): the package or file that is not installed
    """

    summary: str
    needs: tuple[str, ...]
    run: Callable[..., np.ndarray]
    options: dict[str, Any]
    missing: Callable[[], str] = lambda: ""


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


def _l2(data: Repaired, alpha: float | str) -> np.ndarray:
    return poisson.l2(data.image, data.dx, data.dy, _alpha(data, alpha, norm=2), data.trusted)


def _l1(data: Repaired, alpha: float | str) -> np.ndarray:
    return poisson.l1(data.image, data.dx, data.dy, _alpha(data, alpha, norm=1), data.trusted)


def _cv(data: Repaired) -> np.ndarray:
    return controlvariates.cv(data.image, data.dx, data.dy, data.trusted)


def _nfor(data: Repaired) -> np.ndarray:
    assert data.noise is not None
    return nfor.nfor(data.image, data.noise, [data.features[name] for name in _FEATURES])


def _with_variances(solver: Callable[..., np.ndarray]) -> Callable[[Repaired], np.ndarray]:
    return lambda data: solver(data.image, data.dx, data.dy, *data.variances, data.trusted)


def _alpha(data: Repaired, alpha: float | str, norm: int) -> float:
    """The number that alpha stands for: "auto" is derived from the variances, and the fixed default without them."""
    if not isinstance(alpha, str):
        return alpha
    if alpha != "auto":
        raise NgptError(f"alpha '{alpha}': must be a number, or 'auto' to derive it from the variances")
    if data.variances is None:
        return poisson.DEFAULT_ALPHA
    primal_var, dx_var, dy_var = data.variances
    return auto_alpha(primal_var, dx_var, dy_var, norm)


def _neural(name: str, also_missing: Callable[[], str] = lambda: "") -> dict[str, Any]:
    """What the entries of all networks share; they take the network of that name in the package, or a file.

    A .onnx runs in ONNX Runtime, .safetensors in PyTorch, each on the devices it has. ``also_missing`` is asked for
    what else the method cannot do without.
    """
    shipped = WEIGHTS / f"{name}.onnx"

    def missing() -> str:
        if find_spec("onnxruntime") is None:
            return "ONNX Runtime is not installed: pip install onnxruntime"
        if not shipped.is_file():
            return "no network is shipped for it: pass weights=FILE, .onnx or .safetensors"
        return also_missing()

    def run(data: Repaired, weights: str, device: str, memory: int) -> np.ndarray:
        path = Path(weights or shipped)
        if path.suffix == ".safetensors":
            if find_spec("torch") is None or find_spec("safetensors") is None:
                raise NgptError(f"method '{name}': {path.name} needs PyTorch: pip install 'ngpt-recon[train]'")
            # torch takes seconds to come in.
            from ngpt.network import run_torch

            return run_torch.run(data, path, device)
        return _by_onnx(data, path, device, memory)

    return {"run": run, "options": {"weights": "", "device": "auto", "memory": run_onnx.MEMORY}, "missing": missing}


def _by_onnx(data: Repaired, path: Path, device: str, memory: int) -> np.ndarray:
    network = run_onnx.Network(path, device)
    layers = {"primal": data.image, **data.features, **data.known_variances()}
    if data.dx is not None:
        layers |= {"dx": data.dx, "dy": data.dy}
    if lacking := [name for name in network.needs if name not in layers]:
        raise NgptError(f"weights {path} need layers {', '.join(lacking)}, which the stack lacks")
    # NumPy does these sweeps several times faster than the graph would.
    base = METHODS[network.base].run(data, **METHODS[network.base].options) if network.base else None
    layers |= combine.images(data, base, network.inputs)
    return network.reconstruct(layers, base, memory=memory)


WEIGHTS = Path(__file__).parent / "weights"
_GRADIENTS = ("primal", "dx", "dy")
_FEATURES = ("albedo", "normal", "depth")
_VARIANCES = ("primal_var", "dx_var", "dy_var")

METHODS = {
    "primal": Method("the Monte Carlo estimate as it is", ("primal",), _primal, {}),
    # The derived alpha lowers the error of l2 by half, and is no better than the fixed one for l1.
    "l2": Method("screened Poisson, least squares: unbiased, fast", _GRADIENTS, _l2, {"alpha": "auto"}),
    "l1": Method(
        "screened Poisson, least norms: robust to outliers", _GRADIENTS, _l1, {"alpha": poisson.DEFAULT_ALPHA}
    ),
    "cv": Method("uniform control variates: close to l2, unbiased", _GRADIENTS, _cv, {}),
    "wcv": Method(
        "control variates weighted by variance: the best of these",
        (*_GRADIENTS, *_VARIANCES),
        _with_variances(controlvariates.wcv),
        {},
    ),
    "wl2": Method("least squares weighted by variance", (*_GRADIENTS, *_VARIANCES), _with_variances(weighted.wl2), {}),
    "ngpt-fast": Method(
        "small neural network, quick on a CPU", (*_GRADIENTS, *_FEATURES, *_VARIANCES), **_neural("ngpt-fast")
    ),
    "ngpt-combine": Method(
        "OIDN's images and the gradients, weighed and corrected by a small network",
        (*_GRADIENTS, *_FEATURES, *_VARIANCES),
        **_neural("ngpt-combine", oidn.missing),
    ),
    "ngpt-primal": Method(
        "the same without gradients: OIDN's image, corrected by a small network that knows the noise",
        ("primal", *_FEATURES, "primal_var"),
        **_neural("ngpt-primal", oidn.missing),
    ),
    "ngpt": Method("neural network of the paper's size", (*_GRADIENTS, *_FEATURES), **_neural("ngpt")),
    # Those below see no gradients.
    "nlm": Method(
        "peer: joint non-local means of scikit-image",
        ("primal", "albedo", "normal", "primal_var"),
        nlm.nlm,
        {},
        nlm.missing,
    ),
    "nfor": Method("peer: first-order regression on features", ("primal", *_FEATURES, "primal_var"), _nfor, {}),
    "oidn": Method(
        "peer: Intel Open Image Denoise",
        ("primal", "albedo", "normal"),
        oidn.oidn,
        {"auxiliary": "prefiltered", "quality": "high"},
        oidn.missing,
    ),
}


def choose(stack: GradientStack) -> str:
    """The method that ``auto`` stands for: the best of those that the stack's layers and this machine's packages allow.

    Geometric means of the trimmed relMSE over thirteen scenes at 4, 16, 64 and 256 spp, in thousandths, of
    docs/RESULTS.md: ngpt-combine, which needs OIDN, 12.5, 6.0, 2.9, 1.7; ngpt-fast 19.1, 8.1, 3.7, 2.0; wcv 42.8,
    14.9, 5.4, 2.4; l1 61.5, 18.8, 6.1, 2.5. Beyond, the networks go over to wcv. ngpt-primal, for stacks without
    gradients, has 12.0, 6.2, 3.6, 2.2 at the same time.
    """
    for name in ("ngpt-combine", "ngpt-fast", "wcv", "l1", "ngpt-primal"):
        entry = METHODS[name]
        if all(layer in stack for layer in entry.needs) and not entry.missing():
            return name
    return "primal"


def reconstruct(stack: GradientStack, method: str = "auto", **options) -> Result:
    """Runs a method on a stack and says what it did.

    ``method`` is ``auto`` or a name in ``METHODS``; ``options`` are the method's own: for l2 and l1 ``alpha``, a number
    or "auto" to derive it from the variances. Raises NgptError for an unknown method or option, missing layers, and a
    primal without any finite pixel.
    """
    start = time.perf_counter()
    name = choose(stack) if method == "auto" else method
    if name not in METHODS:
        raise NgptError(f"unknown method '{name}'; choose one of: auto, {', '.join(METHODS)}")
    entry = METHODS[name]
    if method == "auto":
        # Where and in how much memory concerns only some of those it may stand for.
        idle = {"device", "memory"} - entry.options.keys()
        options = {option: value for option, value in options.items() if option not in idle}
    for option in options:
        if option not in entry.options:
            raise NgptError(f"method '{name}' has no option '{option}'; it has: {', '.join(entry.options) or 'none'}")
    if entry.missing() and not options.get("weights"):
        raise NgptError(f"method '{name}': {entry.missing()}")
    # What the weights of a network need, they say themselves.
    stack.require(*(("primal",) if options.get("weights") else entry.needs), why=f"method '{name}'")
    data = repair(stack)
    # Extreme values may leave the range of float32 inside; what comes out is checked.
    with np.errstate(over="ignore", invalid="ignore"):
        image = entry.run(data, **(entry.options | options)) + data.direct
    lost = int(np.sum(~np.isfinite(image).all(axis=-1)))
    if lost:
        file = f" with {options['weights']}" if options.get("weights") else ""
        raise NgptError(
            f"{stack.path}: method '{name}'{file} gave {lost} non-finite pixels; the largest input value is "
            f"{np.abs(data.image).max():.3g}: scale the stack down, or use another method"
        )
    return Result(
        np.ascontiguousarray(image, np.float32), name, time.perf_counter() - start, data.pixels, data.gradients
    )


def denoise(stack: GradientStack, method: str = "auto", **options) -> np.ndarray:
    """The reconstruction of a stack, (H, W, 3) float32, scene-linear: ``reconstruct(stack, method).image``."""
    return reconstruct(stack, method, **options).image
