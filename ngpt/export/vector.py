"""Writes a small stack and a model's result for it to files that any language can read, to test hosts."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx

from ngpt.io.rawlayers import write_layers
from ngpt.network.run_onnx import runtime

SIZE = 29, 23  # width and height: odd, and no multiple of any alignment


def write_vector(model: onnx.ModelProto, folder: Path, overwrite: bool = False) -> None:
    """Writes the inputs of a model, and its result as ``image``, into a folder; see ``ngpt.io.rawlayers``."""
    names = {item.key: item.value for item in model.metadata_props}["ngpt.inputs"].split(", ")
    arrays = {name: layer for name, layer in example_layers().items() if name in names}
    session = runtime().InferenceSession(model.SerializeToString(), quiet(), providers=["CPUExecutionProvider"])
    arrays["image"] = session.run(["image"], arrays)[0]
    write_layers(folder, arrays, overwrite)


def quiet() -> Any:
    """Options that suppress the warnings that inputs have defaults."""
    options = runtime().SessionOptions()
    options.log_severity_level = 3
    return options


def example_layers() -> dict[str, np.ndarray]:
    """Layers (1, C, height, width) of a noisy picture, the same on every machine.

    The picture has a bright disk on a gradient, a lamp, its image in a mirror, and rare bright light that gradients
    exclude. Every kind of layer has non-finite values in single pixels, the primal also in a hole of 7x7 pixels, and
    some variances are -1.
    """
    width, height = SIZE
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    disk = (x - 17) ** 2 + (y - 9) ** 2 < 36
    clean = np.stack([0.2 + 0.02 * x, 0.3 + 0.01 * y, np.full_like(x, 0.25)]) * np.where(disk, 6.0, 1.0)
    deviation = 0.4 * clean
    layers = {"primal": clean * rng.gamma(6.0, 1 / 6.0, clean.shape), "primal_var": deviation**2}
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
    _light(layers, np.s_[:, 1:4, 4:10], np.s_[:, 17:22, 2:14])
    spark = np.random.default_rng(8).gamma(0.5, 4, clean.shape) * (
        np.random.default_rng(9).random((height, width)) > 0.9
    )
    layers["caustic"], layers["caustic_var"] = spark, spark**2 / 2
    layers["primal"] += spark
    others = {"denoised_caustic": 0.5 * spark, "denoised_base": 0.99 * clean + layers["direct"]}
    others["denoised"] = 1.02 * clean + layers["direct"] + others["denoised_caustic"]
    _damage(layers)
    return {name: np.ascontiguousarray(layer[None], np.float32) for name, layer in (others | layers).items()}


def _light(layers: dict[str, np.ndarray], lamp: tuple, mirror: tuple) -> None:
    """Adds a lamp, and a mirror that shows it. In a mirror, features are those of the reflected object."""
    direct = layers["direct"] = np.zeros_like(layers["primal"])
    direct[lamp] = np.reshape([60.0, 50.0, 35.0], (3, 1, 1))
    direct[mirror][:, 1:4, 2:8] = 0.9 * direct[lamp]
    layers["primal"] += direct
    # At the border of a lamp, only some samples of a pixel hit it, so its variance is larger.
    layers["primal_var"] += (0.3 * direct) ** 2
    layers["albedo"][mirror], layers["depth"][mirror] = 0.7, 6.0
    layers["normal"][mirror] = np.reshape([0.0, -1.0, 0.0], (3, 1, 1))


def _damage(layers: dict[str, np.ndarray]) -> None:
    layers["primal"][1, 7, 3] = layers["primal"][:, 2, 10] = np.nan
    layers["primal"][0, 12, 24], layers["direct"][2, 20, 22] = np.inf, np.nan
    layers["primal"][:, 13:20, 18:25] = np.nan
    layers["dx"][0, 9, 11], layers["dy"][:, 5, 20] = np.nan, -np.inf
    layers["caustic"][2, 21, 5], layers["caustic_var"][:, 19:23, 16:24] = np.nan, -1
    layers["primal_var"][:, 8, 8], layers["dx_var"][:, 4, 25], layers["dy_var"][2, 10, 13] = -1, -1, np.inf
    layers["albedo"][1, 6, 6], layers["normal"][:, 15, 3], layers["depth"][0, 1, 20] = np.nan, np.nan, np.inf
