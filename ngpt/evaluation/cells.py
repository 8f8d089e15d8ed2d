"""One cell of the table: a method on a stack against the reference; computed once, then taken from the cache."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.evaluation.config import Column, Config
from ngpt.evaluation.stacks import write_json
from ngpt.io.exr import write
from ngpt.measure import metrics, perceptual
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack
from ngpt.version import __version__

# The rooms that decide no image and no number.
_PRESENTATION = {"cli", "evaluation", "export", "report", "system"}


class Scorer:
    """Runs methods warm and measures what they give."""

    def __init__(self, config: Config, cache: Path):
        self.config, self.cache = config, cache
        self.cache.mkdir(parents=True, exist_ok=True)
        self._warm: set[tuple] = set()
        self.absent_metrics: dict[str, str] = {}
        self._functions = self._metrics()

    def cell(
        self,
        column: Column,
        stack: Callable[[], GradientStack],
        reference: np.ndarray,
        key: list,
        image: Path | None,
    ) -> dict[str, Any]:
        """``metrics``, ``seconds`` to reconstruct, and ``image`` in whose file it was written, or why it is ``absent``.

        ``key`` is what stack and reference depend on; ``stack`` is called only when the cell is not in the cache.
        """
        parts = [key, column.method, column.options, self.config.metrics, self.config.elpips, code_hash(), versions()]
        parts += [_file_hash(column.options.get("weights", ""))]
        path = self.cache / f"{hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:32]}.json"
        if path.exists() and (image is None or image.exists()):
            return json.loads(path.read_text())
        try:
            data = stack()
            warm = (column.name, data.height, data.width)
            if warm not in self._warm:
                # Files of weights, just-in-time compilation, filters that are made once.
                reconstruct(data, column.method, **column.options)
                self._warm.add(warm)
            result = reconstruct(data, column.method, **column.options)
            scores = self.score(result.image, reference)
        except NgptError as error:
            # Not kept: what is missing may be there the next time.
            return {"absent": str(error)}
        if image is not None:
            image.parent.mkdir(parents=True, exist_ok=True)
            write(image, result.image, overwrite=True)
        cell = {"metrics": scores, "reconstruct": result.seconds, "absent": None}
        write_json(path, cell)
        return cell

    def score(self, image: np.ndarray, reference: np.ndarray) -> dict[str, float | None]:
        """The configuration's metrics; None for what is infinite, as the PSNR of equal images is."""
        cheap = metrics.compare(image, reference)
        finite = [np.nan_to_num(i, nan=0.0, posinf=0.0, neginf=0.0) for i in (image, reference)]
        values: dict[str, float] = {}
        for name in self.config.metrics:
            if name in cheap:
                values[name] = cheap[name]
            elif name in self._functions:
                values[name] = self._functions[name](*finite)
        return {name: value if math.isfinite(value) else None for name, value in values.items()}

    def _metrics(self) -> dict[str, Callable[[np.ndarray, np.ndarray], float]]:
        """Those of ``ngpt.measure.perceptual`` that are asked for and possible here."""
        result: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {}
        for name in set(self.config.metrics) & {"SSIM", "FLIP", "E-LPIPS"}:
            lack = perceptual.missing(name)
            if not lack and name == "E-LPIPS":
                try:
                    files = self.config.elpips
                    result[name] = perceptual.make_elpips(files.get("backbone", ""), files.get("weights", ""))
                except NgptError as error:
                    lack = str(error)
            if lack:
                self.absent_metrics[name] = lack
        possible = {"SSIM": perceptual.ssim, "FLIP": lambda x, r: perceptual.flip(x, r)[0]}
        wanted = set(self.config.metrics) - self.absent_metrics.keys()
        return result | {name: function for name, function in possible.items() if name in wanted}


def absence(column: Column) -> str:
    """Why a column cannot be computed at all here, "" if it can."""
    if column.method not in METHODS:
        return f"there is no method '{column.method}'; choose one of: {', '.join(METHODS)}"
    weights = column.options.get("weights", "")
    if weights and not Path(weights).is_file():
        return f"weights {weights}: no such file; train them first"
    lack = METHODS[column.method].missing()
    return "" if weights and "weights" in lack else lack


@lru_cache(maxsize=1)
def code_hash() -> str:
    """Of the library's source: a cell of other code is another cell."""
    folder = Path(__file__).parents[1]
    files = [f for f in folder.rglob("*.py") if f.relative_to(folder).parts[0] not in _PRESENTATION]
    files += (folder / "weights").iterdir()
    return hashlib.sha256(b"".join(f.read_bytes() for f in sorted(files))).hexdigest()


@lru_cache(maxsize=1)
def versions() -> dict[str, str | None]:
    """Of the packages that numbers depend on; None for those that are not installed."""
    result: dict[str, str | None] = {"ngpt-recon": __version__}
    for name in ("numpy", "scipy", "mitsuba", "torch", "mitsuba-oidn", "scikit-image", "flip-evaluator"):
        try:
            result[name] = version(name)
        except PackageNotFoundError:
            result[name] = None
    return result


def _file_hash(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path and Path(path).is_file() else ""
