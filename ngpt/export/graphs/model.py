"""After ``ngpt.network.model`` (and ``heads``): the whole graph from a renderer's buffers to the image.

    buffers -> clean -> statistics -> normalised -> base -> completed -> encoded -> padded -> [network]
            -> cropped -> head -> (goes over to the base) -> bounds -> exponential -> exposure -> image

All of it is float32, whatever the network is in.
"""

import numpy as np
import onnx

from ngpt.export.builder import Graph, Operators, Value, channels, choose, op
from ngpt.export.graphs import controlvariates, exposure, features
from ngpt.export.graphs.controlvariates import IMAGE
from ngpt.export.graphs.padding import Mirror
from ngpt.export.graphs.repair import clean
from ngpt.export.graphs.transfer import signed_exp, signed_log
from ngpt.network.features import CHANNELS
from ngpt.network.inputs import DENOISED, LAYERS
from ngpt.network.model import DARK, HUGE, WINDOW, ModelConfig

_VARIANCES = ("primal_var", "dx_var", "dy_var")


class _OperatorsOfHeads(Operators):
    signed_log = staticmethod(signed_log)


def layers(config: ModelConfig) -> tuple[str, ...]:
    """The inputs of the graph of such a model, in order."""
    return tuple(name for name in (*LAYERS, *DENOISED) if name in (*config.needs, *config.layers))


def reconstruction(config: ModelConfig, alignment: int, network: onnx.ModelProto) -> Graph:
    """The graph around a network of that configuration, ``channels`` to ``prediction``."""
    graph = Graph("reconstruction")
    raw = _buffers(graph, layers(config))
    finite = _finite(raw)
    given = graph.input("statistics", (5,), np.zeros(5))
    is_given = op.Greater(op.ReduceMax(op.Slice(given, [0], [1]), keepdims=0), 0.0)
    shared = choose(is_given, lambda: op.Identity(given), lambda: _statistics(config, finite), (5,))
    scale, depth, low, high, mean = (
        op.ReduceMax(op.Slice(shared, [i], [i + 1]), keepdims=0) for i in range(len(exposure.STATISTICS))
    )
    scaled = features.normalised(finite, config.layers, scale, depth)
    if config.base:
        scaled["base"] = _base(graph, raw, finite, scale, mean)

    mirror = Mirror(raw["primal"], alignment)
    completed = features.completed(scaled, config.inputs)
    # Signs survive the logarithm, so padding may come after it.
    padded = [mirror.pad(features.encoded(name, completed[name]), name) for name in config.inputs]
    prediction = graph.include(network, "network/", op.Concat(*padded, axis=1))

    head = config.head
    read = dict(scaled)
    if "reflectance" in head.reads:
        read["reflectance"] = features.reflectance(scaled["albedo"])
    images = [mirror.extended(read[name], head.radius) for name in head.reads]
    logarithm = mirror.crop(head.graph(_OperatorsOfHeads(), prediction, images))
    if config.quiet:
        base = signed_log(scaled["base"])
        share = mirror.crop(_share(mirror, scaled["primal_se"], scaled["base"], config.quiet))
        logarithm = base + (logarithm - base) * share
    bounded = op.Min(op.Max(logarithm, signed_log(low / scale)), signed_log(high / scale))
    graph.output("image", signed_exp(bounded) * scale, IMAGE)
    return graph


def statistics(config: ModelConfig) -> Graph:
    """The graph that tells what the tiles of an image share."""
    graph = Graph("statistics_of")
    used = ("primal", "depth", *(_VARIANCES if config.base else ()))
    raw = _buffers(graph, tuple(name for name in layers(config) if name in used))
    graph.output("statistics", _statistics(config, _finite(raw)), (5,))
    return graph


def _buffers(graph: Graph, names: tuple[str, ...]) -> dict[str, Value]:
    return {name: graph.input(name, ("tiles", CHANNELS.get(name, 3), "height", "width")) for name in names}


def _finite(raw: dict[str, Value]) -> dict[str, Value]:
    """The layers with 0 for what is not finite; variances as they are, since it depends on the use what is unknown."""
    return {name: layer if name in _VARIANCES else clean(layer) for name, layer in raw.items()}


def _statistics(config: ModelConfig, finite: dict[str, Value]) -> Value:
    return exposure.statistics(finite, tuple(finite[name] for name in _VARIANCES) if config.base else None)


def _base(graph: Graph, raw: dict[str, Value], finite: dict[str, Value], scale: Value, mean: Value) -> Value:
    """The base that the host gives, over the exposure, or else control variates."""
    given = graph.input("base", ("tiles", 3, "base_height", "base_width"), np.zeros((1, 3, 0, 0)))
    primal, dx, dy = (finite[name] / scale for name in ("primal", "dx", "dy"))
    trusted = controlvariates.trusted(raw["dx"]), controlvariates.trusted(raw["dy"])
    variances = tuple(finite[name] for name in _VARIANCES)
    return choose(
        op.Equal(op.Size(given), 0),
        lambda: controlvariates.wcv(primal, dx, dy, trusted, variances, mean),
        lambda: given / scale,
        IMAGE,
    )


def _share(mirror: Mirror, noise: Value, base: Value, quiet: float) -> Value:
    """``Reconstructor.share``: how much the network's result counts beside the base, (N, 1, rows, columns)."""
    noise, light = op.Min(noise, HUGE), op.Min(abs(base), HUGE)
    both = op.Concat(*(op.ReduceMean(x, [1], keepdims=1) for x in (noise * noise, light)), axis=1)
    pads = 4 * [WINDOW // 2]
    means = op.AveragePool(mirror.pad(both), kernel_shape=[WINDOW, WINDOW], pads=pads, count_include_pad=0)
    variance, mean = channels(means, 0, 1), channels(means, 1, 2)
    share = op.Min(op.Sqrt(variance) / ((mean + DARK) * float(quiet)), 1.0)
    return op.Where(op.Greater(variance, 0.0), share, 1.0)
