"""Exports the network that blends frames (``ngpt.sequence.network``) as ONNX, for (1, C, H, W) of aligned sizes."""

import json
from pathlib import Path

import onnx

from ngpt.export.network import convolutions
from ngpt.sequence.network import INPUTS
from ngpt.sequence.weights import load
from ngpt.version import __version__


def temporal_model(weights: str | Path) -> onnx.ModelProto:
    """The graph for the weights in a file. Raises NgptError if they are not of a network that blends frames."""
    model, header = load(weights)
    proto = convolutions(model, len(INPUTS), model.alignment, "inputs", "corrections")
    proto.producer_name, proto.producer_version = "ngpt", __version__
    overlap = -(-model.radius // model.alignment) * model.alignment
    metadata = {
        "version": __version__,
        "method": "temporal",
        "temporal inputs": ", ".join(INPUTS),
        "alignment": str(model.alignment),
        "overlap": str(overlap),
        "training": json.dumps(header.get("training", {})),
    }
    onnx.helper.set_model_props(proto, {f"ngpt.{key}": value for key, value in metadata.items()})
    onnx.checker.check_model(proto, full_check=True)
    return proto
