"""Folders of stacks that need no renderer."""

from pathlib import Path

import numpy as np

import ngpt
from data_gen import service
from ngpt.classical.gradients import forward_differences
from ngpt.evaluation.config import EvaluationConfig, read_config
from ngpt.evaluation.run import evaluate
from ngpt.stack import GradientStack
from ngpt.system.console import Console


def smooth_image() -> np.ndarray:
    """24x17, about 1."""
    y, x = np.mgrid[0:17, 0:24] / 10
    return np.stack([1 + np.sin(x + c) * np.cos(y) / 2 for c in range(3)], axis=-1)


def write_scene(folder: Path, rng: np.random.Generator, spp=(4, 16), seeds=2, gradients="gradients") -> np.ndarray:
    """A folder of stacks of a smooth image, 24x17, whose noise falls with the samples; returns the image."""
    folder.mkdir(exist_ok=True)
    clean = smooth_image()
    features = {"albedo": clean / 2, "normal": np.zeros_like(clean), "depth": np.ones((17, 24, 1))}
    for n in spp:
        for seed in range(seeds):
            noisy = {"primal": clean + rng.normal(0, 0.5 / n**0.5, clean.shape)}
            noisy["primal_var"] = np.full_like(clean, 0.25 / n)
            for name, difference in zip(("dx", "dy"), forward_differences(clean), strict=True):
                noisy[name] = difference + rng.normal(0, 0.1 / n**0.5, clean.shape)
                noisy[f"{name}_var"] = np.full_like(clean, 0.01 / n)
            primal = {name: noisy[name] for name in ("primal", "primal_var")}
            attributes = {"ngpt:seconds": 0.1 * n, "ngpt:spp": n}
            for kind, layers in ((gradients, noisy | features), ("features", primal | features), ("path", primal)):
                stack = GradientStack.from_arrays(attributes=attributes, **layers)
                ngpt.write(folder / f"{kind}-{n}-{seed}.exr", stack, overwrite=True)
    ngpt.write(folder / "reference.exr", clean.astype(np.float32), overwrite=True)
    return clean


def write_halves(folder: Path, rng: np.random.Generator, deviation: float, name: str = "reference") -> None:
    """Two noisy halves of a reference of ``smooth_image``, with their variances, instead of the one without noise."""
    (folder / "reference.exr").unlink(missing_ok=True)
    clean = smooth_image()
    for half in "ab":
        layers = {"primal": clean + rng.normal(0, deviation, clean.shape)}
        layers["primal_var"] = np.full_like(clean, deviation**2)
        stack = GradientStack.from_arrays(attributes={"ngpt:spp": 100, "ngpt:seconds": 1.5}, **layers)
        ngpt.write(folder / f"{name}-{half}.exr", stack)


def evaluated(config: EvaluationConfig, out: Path, command: str = "") -> dict:
    return evaluate(config, out, Console(quiet=True), command, service)


def read(text: str, folder: Path) -> EvaluationConfig:
    path = folder / "config.toml"
    path.write_text(text)
    return read_config(path)
