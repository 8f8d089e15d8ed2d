"""The network that blends frames as ONNX: ``inputs`` as of ``ngpt.sequence.network``, (1, C, H, W) of aligned sizes."""

import json
from pathlib import Path

import onnx

from ngpt.errors import NgptError
from ngpt.export.network import convolutions
from ngpt.network.weights import fill, read_tensors
from ngpt.sequence.network import INPUTS
from ngpt.sequence.train import WIDTHS, network
from ngpt.version import __version__


def temporal_model(weights: str | Path) -> onnx.ModelProto:
    """The graph of weights that ``ngpt.sequence.train`` wrote; raises NgptError for others."""
    tensors, header = read_tensors(weights)
    if header.get("kind") != "temporal" or header.get("inputs") != list(INPUTS) or header.get("widths") != list(WIDTHS):
        raise NgptError(f"{weights}: holds no network that blends frames, or one of another version; train it anew")
    model = network()
    fill(model, tensors, str(weights))
    proto = convolutions(model.eval(), len(INPUTS), model.alignment, "inputs", "corrections")
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
