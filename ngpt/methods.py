"""The registry of reconstruction methods, and the function that runs them.

A method of ngpt is an entry in ``_OURS``. Other packages bring methods by entry points of the group "ngpt.methods"
(docs/methods/add-a-method.md). The command line, the reports and the tables find all of them in ``METHODS``.
"""

import logging
import time
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ngpt.classical.bases import CLASSICAL
from ngpt.coverage import empty_pixels, kept_within
from ngpt.denoisers import caustic, nfor, oidn
from ngpt.errors import NgptError, WrongUse, did_you_mean
from ngpt.io.primaries import converted, inside_rec709
from ngpt.layers import GATHERED
from ngpt.magnitude import enlarged, magnitude, scaled
from ngpt.network.identity import Identity, identify
from ngpt.network.inputs import DENOISED, ESTIMATED, Oidn
from ngpt.network.shipped import OPTIONS, Shipped
from ngpt.options import Option, as_text, settings, unusual
from ngpt.panorama import continued, middle, wraps
from ngpt.repair import Repaired, finite_pixels, repair
from ngpt.stack import GradientStack
from ngpt.system.parts import Registry, blamed

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Method:
    """A reconstruction method.

    ``summary``  one line for the user
    ``needs``    layers that the stack must hold
    ``run``      (Repaired, options) -> (H, W, 3) float32, a reconstruction of the light in Repaired's ``image``
    ``options``  the options of the method
    ``standing`` one of ``ngpt.options.STANDINGS``; help lists the methods by their standing
    ``missing``  returns the package or file that the method lacks on this machine; "" if the method can be used
    ``uses``     further layers that the method uses if the stack has them
    ``estimates``  layers that the method estimates from the other layers if the stack lacks them
    ``variant``  the method that this one runs with other defaults; "" if it is not a variant
    ``apart``    whether the light of photons is taken out of the image and denoised by ``ngpt.denoisers.caustic``
    ``rec709``   whether the method was made for colours of Rec. 709. If it was, colours of other primaries are
                 converted for it if they are within the gamut of Rec. 709
    """

    summary: str
    needs: tuple[str, ...]
    run: Callable[..., np.ndarray]
    options: dict[str, Option]
    standing: str = "niche"
    missing: Callable[[], str] = str
    uses: tuple[str, ...] = ()
    estimates: tuple[str, ...] = ()
    variant: str = ""
    apart: bool = False
    rec709: bool = False


@dataclass(frozen=True)
class Result:
    """A reconstruction and the facts about its making.

    ``image``      (H, W, 3) float32, scene-linear, in the units of the stack's primal
    ``method``     the method that ran, also if "auto" chose it; "own network FILE" for weights that ngpt does not ship
    ``seconds``    wall time of repair and reconstruction, without file access
    ``repaired``   pixels of the primal that were not finite and were replaced
    ``untrusted``  differences that were left out because they, or one of their two pixels, were not finite
    ``weights``    the file of the network that ran; None for methods without one
    ``options``    the options with other values than the method's defaults, except ``weights``
    ``estimated``  layers that the stack lacks, and that the method has estimated
    ``error``      (H, W, 3) float32, the standard error of the image if it was requested (``ngpt.api.uncertainty``)
    """

    image: np.ndarray
    method: str
    seconds: float
    repaired: int
    untrusted: int
    weights: Identity | None = None
    options: dict[str, Any] = field(default_factory=dict)
    estimated: tuple[str, ...] = ()
    error: np.ndarray | None = None

    @property
    def attributes(self) -> dict[str, Any]:
        """Header attributes that say how the image was made, for ``ngpt.write(..., attributes=...)``."""
        made: dict[str, Any] = {"ngpt:method": self.method, "ngpt:reconstructSeconds": self.seconds}
        if self.weights:
            made["ngpt:weights"] = str(self.weights)
        if self.options:
            made["ngpt:options"] = as_text(self.options)
        if self.estimated:
            made["ngpt:estimated"] = ", ".join(self.estimated)
        return made


def _primal(data: Repaired) -> np.ndarray:
    return data.image


def _nfor(data: Repaired) -> np.ndarray:
    noise = nfor.estimated_variance(data.image) if data.noise is None else data.noise
    return nfor.nfor(data.image, noise, [data.features[name] for name in _FEATURES if name in data.features])


def _classical(name: str, summary: str, standing: str = "niche") -> Method:
    entry = CLASSICAL[name]
    return Method(summary, entry.needs, entry.solve, entry.options, standing)


def _network(
    name: str,
    summary: str,
    needs: tuple[str, ...],
    standing: str = "use",
    also_missing: Callable[[], str] = str,
    estimates: tuple[str, ...] = (),
) -> Method:
    network = Shipped(name, also_missing)
    return Method(summary, needs, network.run, OPTIONS, standing, network.missing, estimates=estimates)


def _variant(method: str, summary: str, **options: Any) -> Method:
    """Returns a method with other defaults as a separate method, so that tables can name it."""
    entry = _OURS[method]
    other = {name: replace(entry.options[name], default=value) for name, value in options.items()}
    return replace(entry, summary=summary, options=entry.options | other, variant=method)


_GRADIENTS = ("primal", "dx", "dy")
_FEATURES = ("albedo", "normal", "depth")

_OURS = {
    "primal": Method("the Monte Carlo estimate as it is", ("primal",), _primal, {}),
    "l2": _classical("l2", "screened Poisson with the L2 norm, unbiased and fast"),
    "l1": _classical("l1", "screened Poisson with the L1 norm, robust to outliers", "use"),
    "cv": _classical("cv", "uniform control variates, close to l2 and unbiased"),
    "wcv": _classical("wcv", "control variates weighted by variance, the best without a network", "use"),
    "wl2": _classical("wl2", "least squares weighted by variance"),
    "ngpt-fast": _network(
        "ngpt-fast", "small network with gradients, quick on a CPU", (*_GRADIENTS, *_FEATURES), estimates=ESTIMATED
    ),
    "ngpt-combine": _network(
        "ngpt-combine",
        "small network that combines OIDN's images and the gradients",
        (*_GRADIENTS, *_FEATURES),
        also_missing=oidn.missing,
        estimates=ESTIMATED,
    ),
    "ngpt-primal": _network(
        "ngpt-primal",
        "small network without gradients that corrects OIDN's image by the noise level",
        ("primal", *_FEATURES, "primal_var"),
        also_missing=oidn.missing,
    ),
    "ngpt": _network("ngpt", "neural network of the paper's size", (*_GRADIENTS, *_FEATURES), "niche"),
    # The methods below do not use gradients.
    "nfor": Method(
        "first-order regression on albedo, normal and depth, for machines without OIDN",
        ("primal",),
        _nfor,
        {},
        "use",
        uses=_FEATURES,
        estimates=("primal_var",),
    ),
    "oidn": Method(
        "Intel Open Image Denoise; reads colour, and albedo and normal if there are any",
        ("primal",),
        oidn.oidn,
        oidn.OPTIONS,
        "use",
        oidn.missing,
        uses=("albedo", "normal"),
        apart=True,
        rec709=True,
    ),
}
_OURS |= {
    "oidn-clean": _variant("oidn", "OIDN that treats the features as clean", auxiliary="clean"),
    "oidn-noisy": _variant("oidn", "OIDN that treats the features as noisy", auxiliary="noisy"),
    "oidn-fast": _variant(
        "oidn", "OIDN's quickest network, with the features as they are", auxiliary="clean", quality="fast"
    ),
}
METHODS = Registry("ngpt.methods", "method", Method, _OURS)


def by_standing(*standings: str) -> dict[str, Method]:
    """The methods of these standings, by name, without variants."""
    return {name: entry for name, entry in METHODS.items() if entry.standing in standings and not entry.variant}


def unknown_method(name: str) -> WrongUse:
    """The error for an unknown method."""
    return METHODS.unknown(name, ("auto", *METHODS), f"auto, {', '.join(by_standing('use', 'niche'))}")


def runnable(name: str) -> Method:
    """The method of that name. Raises WrongUse if there is none, and NgptError if it lacks a package or a file."""
    if name not in METHODS:
        raise unknown_method(name)
    if lack := METHODS[name].missing():
        raise NgptError(f"method '{name}' cannot be used: {lack}; name another, or auto")
    return METHODS[name]


# The methods that "auto" chooses from, the best first (docs/lab/RESULTS.md, "By the layers of a stack"). ngpt-primal is
# left out. In the same total time, its error equals OIDN's in blind rooms (which no training or choice has used), and
# is larger than OIDN's in simple scenes.
ORDER = ("ngpt-combine", "oidn", "ngpt-fast", "wcv", "l1", "nfor")


def choose(layers: Container[str], usable: Callable[[str], bool] | None = None) -> str:
    """The name of the method that "auto" runs: the best one for these layers and the installed packages.

    ``layers``  a stack, or the names of its layers. The method in a stack's attribute ``ngpt:for`` is preferred
    ``usable``  whether the method of a name can be used; None: if it lacks nothing on this machine
    """
    usable = usable or (lambda name: not METHODS[name].missing())
    made_for = str(layers.attributes.get("ngpt:for")) if isinstance(layers, GradientStack) else ""
    for name in (made_for, *ORDER):
        if name in METHODS and all(layer in layers for layer in METHODS[name].needs) and usable(name):
            return name
    return "primal"


def check_request(method: str, options: Mapping[str, Any]) -> None:
    """Raises NgptError if ``reconstruct`` would refuse this method and these options for any stack.

    ``reconstruct`` refuses them if the method lacks a package, an option is unknown or has a wrong value, weights are
    unreadable, or a device is unusable.
    """
    own = options.get("weights")
    if own:
        identify(own)
    if method != "auto":
        # A method whose own weights are missing can run with the user's.
        entry = METHODS[method] if own else runnable(method)
        _check_network(method, settings(f"method '{method}'", entry.options, options))
        return
    methods = {"ngpt": METHODS["ngpt"]} if own else METHODS
    for name, value in options.items():
        owners = {owner: entry.options for owner, entry in methods.items() if name in entry.options}
        if not owners:
            meant = did_you_mean(name, {option for entry in methods.values() for option in entry.options})
            raise WrongUse(f"no method has an option '{name}'; {meant}`ngpt info METHOD` lists them".rstrip())
        _check_value(owners, name, value)
    networks = ["ngpt"] if own else [name for name in ORDER if "device" in METHODS[name].options]
    usable = [name for name in networks if own or not METHODS[name].missing()]
    if usable and (own or "device" in options):
        known = METHODS[usable[0]].options
        _check_network(usable[0], settings("", known, {n: v for n, v in options.items() if n in known}))


def _check_value(owners: Mapping[str, dict[str, Option]], name: str, value: Any) -> None:
    """Raises WrongUse if none of the methods in ``owners``, which have the option ``name``, allows this value."""
    refusals = []
    for owner, options in owners.items():
        try:
            settings(f"method '{owner}'", options, {name: value})
            return
        except WrongUse as refusal:
            refusals.append(refusal)
    raise refusals[0]


def _check_network(method: str, values: dict[str, Any]) -> None:
    if "weights" in METHODS[method].options:
        Shipped(method).reads(**values)


def reconstruct(stack: GradientStack, method: str = "auto", **options) -> Result:
    """Runs a method on a stack. The left and right borders of panoramas count as neighbours (``ngpt.panorama``).

    ``method`` is "auto" or a name in ``METHODS``, and ``options`` are options of the method. For example, l2 and l1
    have ``alpha``: a number, or "auto" to derive it from the variances. Raises NgptError for an unknown method or
    option, for missing layers, and for a primal without any finite pixel.
    """
    if wraps(stack):
        result, data = reconstruct(continued(stack), method, **options), repair(stack)
        image = np.ascontiguousarray(middle(result.image))
        return replace(result, image=image, repaired=data.pixels, untrusted=data.gradients)
    start = time.perf_counter()
    own = options.get("weights")
    name = method
    if method == "auto":
        # The file of own weights names the layers that they need, so any method that runs networks can run them.
        name = "ngpt" if own else choose(stack)
    if name not in METHODS:
        raise unknown_method(name)
    entry = METHODS[name]
    if method == "auto":
        # Not all methods that "auto" may choose have these options.
        unused = {"device", "memory"} - entry.options.keys()
        options = {option: value for option, value in options.items() if option not in unused}
    try:
        values = settings(f"method '{name}'", entry.options, options)
    except WrongUse as error:
        # For another stack, "auto" may choose a method with this option, so the call itself is not wrong.
        raise error if method == name else NgptError(str(error)) from None
    if entry.missing() and not own:
        raise NgptError(f"method '{name}': {entry.missing()}")
    stack.require(*(("primal",) if own else entry.needs), why=f"weights {own}" if own else f"method '{name}'")
    reads = Shipped(name).reads(**values) if "weights" in entry.options else entry.needs
    given, matrix = stack, inside_rec709(stack) if entry.rec709 else None
    if matrix is not None:
        light = {name: converted(stack[name], matrix) for name in ("primal", "direct", "caustic") if name in stack}
        fine = stack.fine | ({"primal": converted(stack.fine["primal"], matrix)} if stack.fine else {})
        stack = replace(stack.replace(**light), fine=fine)
    power = magnitude(stack)
    apart = entry.apart and bool(stack.number(GATHERED))
    data = repair(_known(scaled(stack, power), entry.estimates), gradients="dx" in reads or apart)
    if "alpha" in stack:
        data = replace(data, empty=empty_pixels(stack))
    if set(DENOISED) & set(reads):
        data = replace(data, by_oidn=Oidn(data))
    # Extreme values may leave the range of float32 in between. The result is checked below.
    with np.errstate(over="ignore", invalid="ignore"):
        image = _run(name, entry, data, values, stack.path) + data.direct
        if data.caustic is not None:
            spread = caustic.of_photons if apart else caustic.denoised
            image += data.by_oidn.of_caustic if data.by_oidn else spread(data)
    image = enlarged(image, power)
    if matrix is not None:
        image = converted(image, np.linalg.inv(matrix))
    image = _equal_channels_kept(image, given["primal"])
    seconds = time.perf_counter() - start
    _LOG.info("%s: method %s, %.3g s, options %s", stack.path, name, seconds, values or "none")
    if data.pixels or data.gradients:
        _LOG.info("%s: %d pixels repaired, %d differences left out", stack.path, data.pixels, data.gradients)
    weights = identify(own or Shipped(name).path) if "weights" in entry.options else None
    lost = int(np.sum(~finite_pixels(image)))
    if lost:
        what = f"method '{name}'"
        if weights is not None and not weights.shipped:
            what = f"own network {own} sha256:{weights.sha256[:12]}"
        raise NgptError(
            f"{stack.path}: {what} gave {lost} non-finite pixels; the largest input value is "
            f"{enlarged(np.abs(data.image).max(), power):.3g}: scale the stack down, or use another method"
        )
    return Result(
        np.ascontiguousarray(kept_within(image, given), np.float32),
        weights.method if weights else name,
        seconds,
        data.pixels,
        data.gradients,
        weights,
        unusual(entry.options, {key: value for key, value in values.items() if key != "weights"}),
        () if own else tuple(layer for layer in entry.estimates if layer not in data.known_variances()),
    )


def _run(name: str, entry: Method, data: Repaired, values: Mapping[str, Any], path: str) -> np.ndarray:
    """The result of the method. Any exception of another package's method becomes an NgptError."""
    try:
        return entry.run(data, **values)
    except Exception as error:
        if name in _OURS or isinstance(error, NgptError):
            raise
        raise NgptError(f"{path}: method '{name}' failed: {blamed(error)}") from error


def _equal_channels_kept(image: np.ndarray, primal: np.ndarray) -> np.ndarray:
    """The image (H, W, 3), in which channels that are equal in the primal are made equal, so that grey stays grey.

    Methods that read the three colours together may give equal channels different results. Their mean has less noise.
    """
    first = [next(b for b in range(a + 1) if np.array_equal(primal[..., a], primal[..., b], True)) for a in range(3)]
    if first == [0, 1, 2]:
        return image
    return np.stack([image[..., np.equal(first, a)].mean(axis=-1, dtype=np.float64) for a in first], axis=-1)


def _known(stack: GradientStack, estimates: tuple[str, ...]) -> GradientStack:
    """The stack without layers of ``estimates`` that have no finite value, so that the method estimates them."""
    unknown = [name for name in estimates if name in stack and not np.isfinite(stack[name]).any()]
    layers = {name: stack[name] for name in stack.names if name not in unknown}
    return replace(stack, layers=layers) if unknown else stack
