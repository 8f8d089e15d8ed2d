"""A small stack and what a model makes of it, in files that any language reads: for those who write a host."""

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output

SIZE = 29, 23  # width and height: odd, and no multiple of any alignment


def write_vector(model: onnx.ModelProto, folder: Path, overwrite: bool = False) -> None:
    """Writes ``NAME.f32``, the inputs, ``image.f32``, what the model makes of them, and ``vector.json`` into a folder.

    The former are float32, little-endian, (1, C, height, width) in C order; the latter lists their shapes and SHA-256
    sums. Raises NgptError where a file exists and may not be overwritten.
    """
    if folder.exists() and not folder.is_dir():
        raise NgptError(f"{folder}: is a file; give a folder for the test vector")
    folder.mkdir(parents=True, exist_ok=True)
    names = {item.key: item.value for item in model.metadata_props}["ngpt.inputs"].split(", ")
    arrays = {name: layer for name, layer in example_layers().items() if name in names}
    session = onnxruntime.InferenceSession(model.SerializeToString(), quiet(), providers=["CPUExecutionProvider"])
    arrays["image"] = session.run(["image"], arrays)[0]
    listing = {}
    for name, array in arrays.items():
        data = np.ascontiguousarray(array, "<f4").tobytes()
        with atomic_output(folder / f"{name}.f32", overwrite) as temporary:
            temporary.write_bytes(data)
        listing[name] = {"shape": list(array.shape), "sha256": hashlib.sha256(data).hexdigest()}
    with atomic_output(folder / "vector.json", overwrite) as temporary:
        temporary.write_text(json.dumps(listing, indent=1) + "\n")


def quiet() -> onnxruntime.SessionOptions:
    """Options that keep the runtime from warning that inputs have defaults."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    return options


def example_layers() -> dict[str, np.ndarray]:
    """Layers (1, C, height, width) of a noisy picture of a bright disk on a gradient, the same on every machine."""
    width, height = SIZE
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    disk = (x - 17) ** 2 + (y - 9) ** 2 < 36
    clean = np.stack([0.2 + 0.02 * x, 0.3 + 0.01 * y, np.full_like(x, 0.25)]) * np.where(disk, 6.0, 1.0)
    deviation = 0.4 * clean
    others = {"denoised": 1.02 * clean, "denoised_base": 0.99 * clean}
    layers = others | {"primal": clean * rng.gamma(6.0, 1 / 6.0, clean.shape), "primal_var": deviation**2}
    for name, axis in (("dx", 2), ("dy", 1)):
        slope = np.diff(clean, axis=axis, append=np.take(clean, [-1], axis))
        layers[name] = slope + np.where(slope, 0.1 * clean, 0.02 * clean) * rng.normal(size=clean.shape)
        layers[f"{name}_var"] = np.where(slope, 0.1 * clean, 0.02 * clean) ** 2
    for name, last in (("dx", np.s_[:, :, -1]), ("dy", np.s_[:, -1])):
        layers[name][last] = layers[f"{name}_var"][last] = 0
    layers["albedo"] = np.where(disk, 0.8, 0.4) * np.ones_like(clean)
    layers["normal"] = np.stack([np.where(disk, (x - 17) / 8, 0), np.zeros_like(x), np.ones_like(x)])
    layers["normal"] /= np.linalg.norm(layers["normal"], axis=0)
    layers["depth"] = np.where(disk, 2.0, 3 + 0.05 * y)[None]
    return {name: np.ascontiguousarray(layer[None], np.float32) for name, layer in layers.items()}
