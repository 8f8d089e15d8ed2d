"""Stacks, references and costs of one scene: rendered once, then taken from the cache.

The cache has a folder for each scene, NAME-HASH, named by what the pictures depend on: the contents of the scene's
files, the size, and the versions that render. In it are KIND-SPP-SEED.exr, where SPP is the number of samples that were
rendered, reference-*.exr and cost-*.json. A folder of stacks of one's own looks the same, without the costs.
"""

from __future__ import annotations

import hashlib
import json
import re
import statistics
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.evaluation.config import Config
from ngpt.io.exr import read, write
from ngpt.measure.metrics import EPSILON
from ngpt.stack import GradientStack
from ngpt.system.files import atomic_output
from ngpt.version import __version__

# Far from the seeds 0, 1 ... of what is judged.
REFERENCE_SEED = 1 << 20


def reference_noise(reference: GradientStack) -> float:
    """What the reference's own noise adds to every relMSE: the mean of its variance / (r² + epsilon)."""
    return float(np.mean(reference["primal_var"] / (reference["primal"] ** 2 + EPSILON)))


def content_hash(scene: str) -> str:
    """SHA-256 over a scene's file and the files it names, those included in turn; over a built-in scene's name."""
    digest = hashlib.sha256()
    if not Path(scene).is_file():
        digest.update(scene.encode())
        return digest.hexdigest()
    queue, seen = [Path(scene)], set()
    while queue:
        path = queue.pop()
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        data = path.read_bytes()
        digest.update(hashlib.sha256(data).digest())
        if path.suffix == ".xml":
            names = sorted(set(re.findall(r'(?:value|filename)="([^"$]+)"', data.decode(errors="replace"))))
            queue += [file for name in names if (file := Path(scene).parent / name).is_file()]
    return digest.hexdigest()


def write_json(path: Path, value: object) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")


class SceneStacks:
    """What one scene's cells are made of."""

    def __init__(self, name: str, source: str, config: Config, cache: Path, say: Callable[[str], None]):
        self.name, self.source, self.config, self.say = name, source, config, say
        self.given = Path(source).is_dir()
        self._scene: Any = None
        self._warm: set[str] = set()
        if self.given:
            self.folder = Path(source)
            return
        parts = [content_hash(source), list(config.size), __version__, _version("mitsuba")]
        self.key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
        self.folder = cache / f"{name}-{self.key[:12]}"
        self.folder.mkdir(parents=True, exist_ok=True)

    def reference(self) -> tuple[GradientStack, str]:
        """The reference and its file name. Raises NgptError where there is none."""
        config, file = self.config, self.config.references.get(self.name)
        if file:
            return read(file), file
        if self.given:
            found = sorted(self.folder.glob("reference*.exr"))
            if not found:
                raise NgptError(f"{self.folder}: no reference: name one reference.exr, or set references.{self.name}")
            return read(found[0]), str(found[0])
        limit = f"{config.reference_spp}spp" if config.reference_spp else f"{config.reference_seconds:g}s"
        path = self.folder / f"reference-{limit}.exr"
        if not path.exists():
            seconds = None if config.reference_spp else config.reference_seconds
            self.say(f"{self.name}: rendering the reference, {limit}")
            scene = self.load()
            from data_gen.render import render_stack

            write(path, render_stack(scene, config.reference_spp or None, REFERENCE_SEED, "primal", seconds=seconds))
        return read(path), str(path)

    def costs(self) -> dict[str, dict[str, float]]:
        """Seconds per sample per pixel count, by kind: median and quartiles of alternating renders, kernels compiled.

        Empty for a folder of stacks that were rendered elsewhere.
        """
        if self.given:
            return {}
        spp, repeats = self.config.timing_spp, self.config.timing_repeats
        path = self.folder / f"cost-{spp}-{repeats}.json"
        if not path.exists():
            self.say(f"{self.name}: measuring what samples cost")
            scene = self.load()
            from data_gen.costs import measure

            seconds, _ = measure(scene, spp, repeats)
            write_json(path, {kind: summary(values) for kind, values in seconds.items()})
        return json.loads(path.read_text())

    def samples(self, kind: str, spp: int, costs: dict[str, dict[str, float]]) -> int:
        """How many samples the time of ``spp`` of the gradient sampler buys; two at least, for a variance."""
        if kind == "gradients" or not costs:
            return spp
        return max(2, round(spp * costs["gradients"]["median"] / costs[kind]["median"]))

    def stack(self, kind: str, spp: int, seed: int) -> GradientStack:
        """A stack with its time in the attribute ``ngpt:seconds``, without the compilation of kernels."""
        path = self.folder / f"{kind}-{spp}-{seed}.exr"
        if not path.exists():
            if self.given:
                raise NgptError(f"{path}: no such stack")
            scene = self.load()
            from data_gen.costs import timed, warm_up

            if kind not in self._warm:
                warm_up(scene, kind)
                self._warm.add(kind)
            stack, seconds = timed(scene, kind, spp, seed)
            stack.attributes["ngpt:seconds"] = seconds
            write(path, stack)
        # Without gradients beside it the reader takes this name for direct light, not for emission seen directly.
        return read(path, {"direct": "direct"} if kind == "features" and not self.given else None)

    def stack_key(self, kind: str, spp: int, seed: int) -> list:
        """What the stack depends on, without rendering it."""
        if not self.given:
            return [self.key, kind, spp, seed]
        path = self.folder / f"{kind}-{spp}-{seed}.exr"
        return [str(path), path.stat().st_mtime_ns if path.exists() else 0]

    def load(self) -> Any:
        if self._scene is None:
            from data_gen.backend import use_variant

            use_variant()
            from data_gen.scenes.load import load_scene

            self._scene = load_scene(self.source, self.config.size)
        return self._scene


def summary(values: list[float]) -> dict[str, float]:
    """Median and quartiles."""
    low, median, high = statistics.quantiles(values, n=4, method="inclusive") if len(values) > 1 else values * 3
    return {"median": median, "low": low, "high": high}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
