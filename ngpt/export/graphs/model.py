"""``ngpt.network.model`` as a graph: the whole graph from a renderer's buffers to the image.

    buffers -> repaired -> statistics -> normalised -> base -> completed -> encoded -> padded -> [network]
            -> cropped -> head -> (goes over to the base) -> bounds -> exponential -> exposure -> emission -> caustic
            -> image

All of it is float32, whatever the precision of the network. Inputs and output include directly visible emission, and
the light that gradients exclude (``caustic``). This light is denoised by another denoiser, or else by a diffusion.
"""

import numpy as np
import onnx

from ngpt.export.builder import Graph, Operators, Value, channels, choose, op
from ngpt.export.graphs import caustic, controlvariates, exposure, features
from ngpt.export.graphs.controlvariates import IMAGE
from ngpt.export.graphs.padding import Mirror
from ngpt.export.graphs.repair import RepairedInputs, clean, repaired
from ngpt.export.graphs.transfer import signed_exp, signed_log
from ngpt.network.config import ModelConfig
from ngpt.network.features import CHANNELS
from ngpt.network.inputs import DENOISED, LAYERS
from ngpt.network.model import DARK, HUGE, WINDOW

_VARIANCES = ("primal_var", "dx_var", "dy_var")
# Light that gradients exclude, and its variance.
_APART = ("caustic", "caustic_var")
# Another denoiser's image of ``caustic``. The same light is also a part of that denoiser's image of the primal.
_FOUND = "denoised_caustic"


class _OperatorsOfHeads(Operators):
    """Operators with ``signed_log`` and ``signed_exp``. ``signed_exp`` of a result of ``signed_log`` adds no nodes."""

    def __init__(self) -> None:
        self._images: dict[str, Value] = {}

    def signed_log(self, image: Value) -> Value:
        result = signed_log(image)
        self._images[result.name] = image
        return result

    def signed_exp(self, logarithm: Value) -> Value:
        return self._images.get(logarithm.name) or signed_exp(logarithm)


def layers(config: ModelConfig) -> tuple[str, ...]:
    """The inputs of the graph for a model of this configuration, in order."""
    needed = ("direct", *config.needs, *config.layers)
    if by_denoiser(config):
        needed += ("caustic", _FOUND)
    elif config.reads_gradients or "primal_var" in needed:
        needed += _APART
    return tuple(name for name in (LAYERS[0], "direct", *LAYERS[1:], *_APART, *DENOISED, _FOUND) if name in needed)


def optional(config: ModelConfig) -> tuple[str, ...]:
    """The layers that may be zero everywhere."""
    return tuple(name for name in layers(config) if name in ("direct", *_APART))


def by_denoiser(config: ModelConfig) -> bool:
    """Whether another denoiser's image of ``caustic`` takes the place of the diffusion."""
    return config.reads_gradients and any(name in config.layers for name in DENOISED)


def reconstruction(config: ModelConfig, alignment: int, network: onnx.ModelProto) -> Graph:
    """The whole graph for a configuration; ``network`` is the network alone, from ``channels`` to ``prediction``."""
    graph = Graph("reconstruction")
    raw = _buffers(graph, layers(config))
    data = _repaired(raw, config)
    given = graph.input("statistics", (5,), np.zeros(5))
    is_given = op.Greater(op.ReduceMax(op.Slice(given, [0], [1]), keepdims=0), 0.0)
    shared = choose(is_given, lambda: op.Identity(given), lambda: _statistics(config, data), (5,))
    scale, depth, low, high, mean = _numbers(shared)
    scaled = features.normalised(data.layers, config.layers, scale, depth)
    if config.base:
        made = graph.input("base", ("tiles", 3, "base_height", "base_width"), np.zeros((1, 3, 0, 0)))
        scaled["base"] = choose(
            op.Equal(op.Size(made), 0), lambda: _base(data, scale, mean), lambda: (made - data.direct) / scale, IMAGE
        )

    mirror = Mirror(raw["primal"], alignment)
    completed = features.completed(scaled, config.inputs)
    # Encoding keeps signs, so padding, which flips some signs, may come after it.
    padded = [mirror.pad(features.encoded(name, completed[name]), name) for name in config.inputs]
    prediction = graph.include(network, "network/", op.Concat(*padded, axis=1))

    head = config.head
    read = dict(completed)
    if "reflectance" in head.reads:
        read["reflectance"] = features.reflectance(scaled["albedo"])
    images = [mirror.extended(read[name], head.radius, name) for name in head.reads]
    logarithm = mirror.crop(head.graph(_OperatorsOfHeads(), prediction, images))
    if config.quiet:
        base = signed_log(scaled["base"])
        share = mirror.crop(_share(mirror, scaled["primal_se"], scaled["base"], config.quiet))
        logarithm = base + (logarithm - base) * share
    bounded = op.Min(op.Max(logarithm, signed_log(low / scale)), signed_log(high / scale))
    image = signed_exp(bounded) * scale + data.direct
    if by_denoiser(config):
        image += data.layers[_FOUND]
    elif config.reads_gradients:
        image += caustic.spread(data.layers, depth)
    graph.output("image", image, IMAGE)
    return graph


def statistics(config: ModelConfig) -> Graph:
    """The graph that computes the statistics for the tiles of an image, and the inputs of another denoiser."""
    graph = Graph("statistics_of")
    used = {"primal", "direct", "caustic", "depth", *(("dx", "dy", *_VARIANCES) if config.base else ())}
    denoised = [name for name in DENOISED if name in config.layers]
    if denoised:
        used |= {"albedo", "normal"}
    data = _repaired(_buffers(graph, tuple(name for name in layers(config) if name in used)), config)
    shared = _statistics(config, data)
    graph.output("statistics", shared, (5,))
    if denoised:
        light = data.layers["primal"]
        if by_denoiser(config):
            light += data.layers["caustic"]
            graph.output("oidn_caustic", op.Identity(data.layers["caustic"]), IMAGE)
        graph.output("oidn_primal", light + data.direct, IMAGE)
        graph.output("oidn_albedo", op.Clip(data.layers["albedo"], 0.0, 1.0), IMAGE)
        graph.output("oidn_normal", op.Identity(data.layers["normal"]), IMAGE)
    if "denoised_base" in denoised:
        scale, _, _, _, mean = _numbers(shared)
        graph.output("oidn_base", _base(data, scale, mean) * scale + data.direct, IMAGE)
    return graph


def _buffers(graph: Graph, names: tuple[str, ...]) -> dict[str, Value]:
    return {name: graph.input(name, ("tiles", CHANNELS.get(name, 3), "height", "width")) for name in names}


def _repaired(raw: dict[str, Value], config: ModelConfig) -> RepairedInputs:
    """The repaired layers, without directly visible emission."""
    data = repaired(raw, config.reads_gradients)
    for name in DENOISED:
        if name in data.layers:
            data.layers[name] = clean(raw[name] - data.direct)
    if "denoised" in data.layers and _FOUND in data.layers:
        data.layers["denoised"] = clean(data.layers["denoised"] - data.layers[_FOUND])
    return data


def _statistics(config: ModelConfig, data: RepairedInputs) -> Value:
    variances = tuple(data.layers[name] for name in _VARIANCES) if config.base else None
    return exposure.statistics(data.layers, variances)


def _numbers(shared: Value) -> tuple[Value, ...]:
    """Exposure, largest depth, least and largest radiance, mean variance: scalars."""
    return tuple(op.ReduceMax(op.Slice(shared, [i], [i + 1]), keepdims=0) for i in range(len(exposure.STATISTICS)))


def _base(data: RepairedInputs, scale: Value, mean: Value) -> Value:
    """The control variates' image, divided by the exposure, without direct emission."""
    primal, dx, dy = (data.layers[name] / scale for name in ("primal", "dx", "dy"))
    variances = tuple(data.layers[name] for name in _VARIANCES)
    return controlvariates.wcv(primal, dx, dy, (data.trusted["dx"], data.trusted["dy"]), variances, mean)


def _share(mirror: Mirror, noise: Value, base: Value, quiet: float) -> Value:
    """``Reconstructor.share``: the weight of the network's result against the base, (N, 1, rows, columns)."""
    noise, light = op.Min(noise, HUGE), op.Min(abs(base), HUGE)
    both = op.Concat(*(op.ReduceMean(x, [1], keepdims=1) for x in (noise * noise, light)), axis=1)
    pads = 4 * [WINDOW // 2]
    means = op.AveragePool(mirror.pad(both), kernel_shape=[WINDOW, WINDOW], pads=pads, count_include_pad=0)
    variance, mean = channels(means, 0, 1), channels(means, 1, 2)
    share = op.Min(op.Sqrt(variance) / ((mean + DARK) * float(quiet)), 1.0)
    return op.Where(op.Greater(variance, 0.0), share, 1.0)
