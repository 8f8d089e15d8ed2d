"""``ngpt.network.features`` as a graph: from layers to the channels that a network reads."""

from collections.abc import Mapping

from ngpt.export.builder import END, Value, op
from ngpt.export.graphs.repair import clean
from ngpt.export.graphs.transfer import log_for_networks, signed_log_for_networks
from ngpt.network.features import ENLARGED, GLOSS, IMAGES, LEAST_DEPTH, NOISE_ENLARGED, RADIANCE, SOURCES, compared


def normalised(finite: Mapping[str, Value], names: tuple[str, ...], exposure: Value, depth: Value) -> dict[str, Value]:
    """The normalised layers of ``names``, as far as they are inputs of the graph or roots of inputs.

    Radiance is divided by the exposure, and depth by the largest depth of the image. ``finite`` are the inputs, which
    are finite except for variances.
    """
    scaled = {}
    for name in names:
        if name.endswith("_se"):
            scaled[name] = op.Sqrt(op.Max(clean(finite[name.replace("_se", "_var")]), 0.0)) / exposure
        elif name in finite:
            scaled[name] = finite[name] / exposure if name in RADIANCE else finite[name]
    if "albedo" in scaled:
        scaled["albedo"] = op.Min(op.Max(scaled["albedo"], 0.0), 1.0)
    if "depth" in scaled:
        scaled["depth"] = scaled["depth"] / (depth + LEAST_DEPTH)
    return scaled


def completed(scaled: Mapping[str, Value], inputs: tuple[str, ...]) -> dict[str, Value]:
    """The layers, with the ``inputs`` that are computed from them; before any padding."""
    return dict(scaled) | {name: _computed(name, scaled, compared(inputs)) for name in inputs if name in SOURCES}


def _computed(name: str, layers: Mapping[str, Value], compared_with: str) -> Value:
    other, source = layers[compared_with], layers[SOURCES[name][0]]
    if name.endswith("_change"):
        return signed_log_for_networks(source) - signed_log_for_networks(other)
    if name.endswith("_noise"):
        return op.ReduceMean(source, [1], keepdims=1) / (op.ReduceMean(abs(other), [1], keepdims=1) + 1.0)
    axis = 3 if name.startswith("dx") else 2
    image = layers[SOURCES[name][1]]
    following = op.Concat(op.Slice(image, [1], [END], [axis]), op.Slice(image, [-1], [END], [axis]), axis=axis)
    return (source - (following - image)) / (abs(other) + 1.0)


def reflectance(albedo: Value) -> Value:
    """A divisor of radiance; see ``ngpt.network.features.reflectance``."""
    return albedo + GLOSS


def encoded(name: str, layer: Value) -> Value:
    """The channels of an input, from its normalised and completed layer."""
    if name in IMAGES:
        return log_for_networks(op.Max(layer, 0.0))
    if name in ("dx", "dy"):
        return signed_log_for_networks(layer)
    if name.endswith("_noise"):
        return log_for_networks(layer * float(NOISE_ENLARGED))
    if name in SOURCES:
        return signed_log_for_networks(layer * float(ENLARGED))
    if name.endswith("_se"):
        return log_for_networks(op.ReduceMean(layer, [1], keepdims=1))
    return layer
