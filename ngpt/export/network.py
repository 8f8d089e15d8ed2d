"""Exports networks as ONNX files that read the raw buffers of a renderer and return the image.

export/CONTRACT.md specifies the files.
"""

import json
import logging
import warnings
from functools import partial
from pathlib import Path

import onnx
import torch

from ngpt.classical.controlvariates import schedule
from ngpt.errors import NgptError
from ngpt.export.builder import IR_VERSION, OPSET
from ngpt.export.graphs.caustic import REACH
from ngpt.export.graphs.exposure import STATISTICS
from ngpt.export.graphs.model import layers, optional, reconstruction, statistics
from ngpt.export.reach import reach
from ngpt.network import features
from ngpt.network.model import Reconstructor
from ngpt.network.safetensors import load_weights
from ngpt.network.unet import Convolution
from ngpt.version import __version__


def network_model(weights: str | Path, name: str, precision: str = "float32") -> onnx.ModelProto:
    """The ONNX graph for the weights in a file. ``name`` is the name of the method in the metadata.

    ``precision`` is the precision of all convolutions except for the last; everything else is always float32. float16
    is for GPUs. On CPUs, ONNX Runtime computes in float32 and converts before and after, which takes longer and hides
    overflows.

    Raises NgptError for weights that cannot be read, and for networks whose base has no graph.
    """
    model, header = _load(weights)
    facts = metadata(model, name, precision) | {"training": json.dumps(header.get("training", {}))}
    return reconstruction(model.config, model.alignment, network_body(model, precision)).model(facts)


def statistics_model(weights: str | Path, name: str) -> onnx.ModelProto:
    """The graph that computes the statistics for the tiles of an image, for the model of these weights."""
    model, _ = _load(weights)
    facts = {"version": __version__, "method": name, "statistics": ", ".join(STATISTICS)}
    return statistics(model.config).model(facts)


def metadata(model: Reconstructor, name: str, precision: str) -> dict[str, str]:
    """Facts that a host may need, by the keys in export/CONTRACT.md."""
    seen, light = reach(model), REACH if "caustic_var" in layers(model.config) else 0

    def overlap(*pixels: int) -> str:
        return str(-(-max(pixels) // model.alignment) * model.alignment)

    return {
        "version": __version__,
        "method": name,
        "inputs": ", ".join(layers(model.config)),
        "layout": "NCHW, float32, row 0 on top, scene-linear",
        "gradient": "forward: dx[y, x] = I[y, x + 1] - I[y, x], last column 0; dy alike",
        "normal": "camera space, +x right, +y up, +z toward the viewer",
        "alignment": str(model.alignment),
        "overlap": overlap(seen + _base_reach(model), light),
        "overlap with base": overlap(seen, light),
        "bytes per pixel": str(bytes_per_pixel(model)),
        "statistics": ", ".join(STATISTICS),
        "precision": precision,
        "base": model.config.base,
        # Layers that may be zeros everywhere
        "optional": ", ".join(optional(model.config)),
    }


def _base_reach(model: Reconstructor) -> int:
    """How far, in pixels, the base and its smoothed weights read, a multiple of the alignment; 0 without a base."""
    return -(-(len(schedule()) + 2) // model.alignment) * model.alignment if model.config.base else 0


def bytes_per_pixel(model: Reconstructor) -> int:
    """An upper bound of the bytes that a run needs for each pixel, in addition to the image's layers.

    tests/network/test_run_onnx.py measures it. The last convolution reads the longest list of tensors. These tensors
    are in memory three times: as the list, joined to one tensor, and about once more. The channels are in memory six
    times, from raw layers to one tensor. The head holds the prediction in three forms. The arena of ONNX Runtime
    allocates more than that, most of all if sizes are halved and doubled without weights. ngpt-combine took 0.6 of its
    bound at 1280x720.
    """
    listed = next(model.network.head.parameters()).shape[1]
    body = 3 * listed + 6 * features.channels(model.config.inputs)
    each = 5.5 if model.config.pooling == "convolution" else 8.5
    return int(each * max(body, 4 * model.config.head.outputs))


def _load(weights: str | Path) -> tuple[Reconstructor, dict]:
    model, header = load_weights(weights)
    if model.config.network == "oidn":
        raise NgptError(f"{weights}: the network has OIDN's shape, which has no graph; export it to a .tza file")
    if split := [name for name in model.config.inputs if name.removesuffix("_se") in features.PARTS]:
        raise NgptError(
            f"{weights}: the network reads {', '.join(split)}, for which there is no ONNX graph; run its weights in "
            "PyTorch: ngpt denoise --weights FILE.safetensors"
        )
    if model.config.base not in ("", "wcv"):
        raise NgptError(
            f"{weights}: the network starts from '{model.config.base}', for which there is no graph; train with 'wcv'"
        )
    return model, header


class _Half(torch.nn.Module):
    """The network in float16, with its last convolution, which predicts logarithms, in float32."""

    def __init__(self, network: torch.nn.Module):
        super().__init__()
        self.network = network.half()
        self.network.head.float()

    def forward(self, channels: torch.Tensor) -> torch.Tensor:
        return self.network(channels.half())


def network_body(model: Reconstructor, precision: str = "float32") -> onnx.ModelProto:
    """The graph of only the network, from ``channels`` to ``prediction``, (N, C, H, W) of any aligned size."""
    inputs = features.channels(model.config.inputs)
    return convolutions(model.network, inputs, model.alignment, "channels", "prediction", precision)


def convolutions(
    network: torch.nn.Module, inputs: int, alignment: int, given: str, made: str, precision: str = "float32"
) -> onnx.ModelProto:
    """The graph of a network of ``ngpt.network.unet``, with the input ``given`` and the output ``made``."""
    for module in network.modules():
        if isinstance(module, Convolution):
            # Weights are normalised once, here, and not in each run of the graph.
            weight = module.weight().detach()
            if precision == "float16" and module is not network.head.convolution:  # type: ignore[union-attr]
                weight = weight.half()
            module.weight = partial(_same, weight)  # type: ignore[method-assign]
    # No size is 0 or 1, because the exporter would take such a size for a constant.
    example = torch.zeros(2, inputs, 5 * alignment, 7 * alignment)
    tiles, rows, columns = (torch.export.Dim(name, min=2, max=1 << 16) for name in ("tiles", "r", "c"))
    # Without this, the exporter would report that torchvision is not installed, although it does not need torchvision.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network if precision == "float32" else _Half(network),
            (example,),
            dynamo=True,
            opset_version=OPSET,
            dynamic_shapes=({0: tiles, 2: alignment * rows, 3: alignment * columns},),
            input_names=[given],
            output_names=[made],
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    proto.ir_version = IR_VERSION
    # Removes the exporter's notes on the origin of each node, which contain paths of this machine.
    for item in (*proto.graph.node, *proto.graph.value_info, *proto.graph.input, *proto.graph.output, proto.graph):
        del item.metadata_props[:]
    del proto.graph.value_info[:]
    return proto


def _same(weight: torch.Tensor) -> torch.Tensor:
    return weight
