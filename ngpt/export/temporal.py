"""The network that blends frames as ONNX: ``inputs`` as in ``ngpt.sequence.network``, (1, C, H, W) of aligned sizes."""

import json
from pathlib import Path

import onnx

from ngpt.export.network import convolutions
from ngpt.sequence.network import INPUTS
from ngpt.sequence.weights import load
from ngpt.version import __version__


def temporal_model(weights: str | Path) -> onnx.ModelProto:
    """The graph for the weights of such a network; raises NgptError for other weights."""
    model, header = load(weights)
    proto = convolutions(model, len(INPUTS), model.alignment, "inputs", "corrections")
    proto.producer_name, proto.producer_version = "ngpt", __version__
    overlap = -(-model.radius // model.alignment) * model.alignment
    told = {
        "version": __version__,
        "method": "temporal",
        "temporal inputs": ", ".join(INPUTS),
        "alignment": str(model.alignment),
        "overlap": str(overlap),
        "training": json.dumps(header.get("training", {})),
    }
    onnx.helper.set_model_props(proto, {f"ngpt.{key}": value for key, value in told.items()})
    onnx.checker.check_model(proto, full_check=True)
    return proto
