"""Describes a file of weights, for ``ngpt info``."""

from collections.abc import Collection
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.network import inputs, run_oidn, run_onnx
from ngpt.network.identity import identify
from ngpt.system.install import install_command
from ngpt.system.records import parse_json
from ngpt.version import __version__

SUFFIXES = (".onnx", ".safetensors", ".tza")
# The key in the metadata that lists the inputs of a network that blends frames (``ngpt.sequence.network``).
FRAMES = "ngpt.temporal inputs"

# The training settings that are shown, by table of the configuration
_SETTINGS = {
    "data": ("folders", "validation"),
    "loss": ("kind",),
    "optimizer": ("learning_rate",),
    "run": ("steps", "batch", "precision"),
}


def describe(path: str | Path) -> dict[str, Any]:
    """The origin, inputs, requirements and training of a network, as a table for people and for JSON.

    Raises NgptError for a file that holds no network of ngpt, and for .safetensors if PyTorch is not installed.
    """
    path = Path(path)
    readers = {".safetensors": _safetensors, ".tza": _tza}
    return readers.get(path.suffix.lower(), _onnx)(path)


def _tza(path: Path) -> dict[str, Any]:
    names, base = run_oidn.reads(path)
    return _whose(path, "weights in OIDN's shape, written by ngpt") | _reads(names, base, "OIDN")


def _onnx(path: Path) -> dict[str, Any]:
    metadata = run_onnx.session(path, "cpu", 0).get_modelmeta().custom_metadata_map
    training = parse_json(metadata.get("ngpt.training", "{}"), f"{path}: its record of the training")
    claims = f"method '{metadata.get('ngpt.method', '')}', written by ngpt {metadata.get('ngpt.version', '?')}"
    if FRAMES in metadata:
        reads = {"inputs": metadata[FRAMES].split(", "), "needs packages": ["ONNX Runtime"]}
        return _whose(path, claims) | reads | {"training": _training(training)}
    network = run_onnx.Network(path)
    names = (*network.inputs, "base") if network.base else network.inputs
    return (
        _whose(path, claims)
        | _reads(names, network.base, "ONNX Runtime")
        | {
            "alignment": network.alignment,
            "overlap of tiles": network.overlap,
            "bytes per pixel": network.bytes,
            "precision": metadata.get("ngpt.precision", "?"),
            "training": _training(training),
        }
    )


def _safetensors(path: Path) -> dict[str, Any]:
    if find_spec("torch") is None or find_spec("safetensors") is None:
        raise NgptError(f"{path}: reading this file needs PyTorch: {install_command('train')}")
    # Importing torch takes seconds.
    from ngpt.network.safetensors import load_weights

    model, header = load_weights(path)
    config, training = model.config, header.get("training", {})
    version = training.get("version", "?") if isinstance(training, dict) else "?"
    return (
        _whose(path, f"weights, written by ngpt {version}")
        | _reads(config.layers, config.base, "PyTorch")
        | {"alignment": model.alignment, "training": _training(training)}
    )


def _whose(path: Path, claims: str) -> dict[str, Any]:
    identity = identify(path)
    ours = f"ngpt's own, method {identity.shipped}: the file that comes with ngpt {__version__}"
    return {
        "network": str(path),
        "whose": ours
        if identity.shipped
        else f"not a network that comes with ngpt {__version__}; the file describes itself as: {claims}",
        "sha256": identity.sha256,
        "bytes": path.stat().st_size,
    }


def _reads(names: Collection[str], base: str, runtime: str) -> dict[str, Any]:
    oidn = ["OIDN"] if set(inputs.DENOISED) & set(names) else []
    return {
        "inputs": list(names),
        "needs layers": list(inputs.needs(names, base)),
        "needs packages": [runtime, *oidn],
        "base": base or "none",
    }


def _training(record: Any) -> dict[str, Any]:
    """Facts from the record of a training.

    The record may come from any program, so entries that do not have the expected type are left out.
    """
    if not isinstance(record, dict):
        return {}
    facts = {name: value for name, value in record.items() if isinstance(value, int | float | str)}
    if isinstance(record.get("mean of"), list):
        facts["mean of"] = (
            f"the average of the weights in {len(record['mean of'])} files; the other entries here describe the first "
            "file"
        )
    settings = record.get("settings")
    for table, names in _SETTINGS.items():
        values = settings.get(table) if isinstance(settings, dict) else None
        if isinstance(values, dict):
            for name in [name for name in names if name in values]:
                value = values[name]
                facts[f"{table}.{name}"] = "; ".join(map(str, value)) if isinstance(value, list) else value
    return facts
