"""Computes the cells of the tables. A cell has the errors and times of a method for one stack. Cells are cached."""

import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.evaluation.config import Column, EvaluationConfig
from ngpt.evaluation.keys import code_of, file_hash, library_hash
from ngpt.evaluation.references import Reference
from ngpt.io.exr import write
from ngpt.measure.metrics import METRICS, scores
from ngpt.methods import METHODS, check_request, reconstruct, unknown_method
from ngpt.stack import GradientStack
from ngpt.subpixels import subpixels
from ngpt.system.files import make_folder
from ngpt.system.machine import versions
from ngpt.system.writing import write_json

# Packages whose versions change results. Without some of them, rows are absent.
PACKAGES = ("numpy", "scipy", "mitsuba", "torch", "mitsuba-oidn", "scikit-image", "flip-evaluator")

# The version of the format of cached cells. Since version 2, cells have times by both clocks, wall and processor.
_FORMAT = 2


class Scorer:
    """Runs methods after a warm-up, and measures their errors and times."""

    def __init__(self, config: EvaluationConfig, cache: Path):
        self.config, self.cache = config, cache
        make_folder(self.cache)
        self._warm: set[tuple] = set()
        self._code = [_FORMAT, library_hash(), versions(*PACKAGES)]
        # The options of metrics, by name.
        self.options = {"E-LPIPS": config.elpips}
        found = {name: METRICS[name].missing for name in config.metrics}
        lacks = {name: missing(**self.options.get(name, {})) for name, missing in found.items() if missing}
        self.absent_metrics = {name: lack for name, lack in lacks.items() if lack}
        self.metrics = [name for name in config.metrics if name not in self.absent_metrics]
        self._code += filter(None, (code_of(METRICS[name].function) for name in self.metrics))

    def cell(
        self, column: Column, stack: Callable[[], GradientStack], reference: Reference, key: list, image: Path | None
    ) -> dict[str, Any]:
        """The entries of a cell: ``metrics``, ``reconstruct`` with the seconds by clock, and ``absent``, which is None.

        If the method fails, the only entry is ``absent``, with the reason. ``key`` identifies the stack in the cache.
        ``stack`` is called only if the cell is not in the cache. The result is written to the file ``image`` unless
        that is None.
        """
        parts = [key, column.method, column.options, file_hash(column.options.get("weights", ""))]
        parts += filter(None, [code_of(METHODS[column.method].run)])
        path = self._path(parts, reference)
        if path.exists() and (image is None or image.exists()):
            return json.loads(path.read_text())
        try:
            data = stack()
            warm = (column.family, data.height, data.width, subpixels(data.fine, data.width))
            if warm not in self._warm:
                # The first run also reads weights, compiles kernels and makes filters, so it is not timed.
                reconstruct(data, column.method, **column.options)
                self._warm.add(warm)
            begins = time.process_time()
            result = reconstruct(data, column.method, **column.options)
            seconds = {"wall": result.seconds, "processor": time.process_time() - begins}
            values = self._scores(self.metrics, result.image, *reference.images)
        except NgptError as error:
            # Not cached, because a missing package or file may be there the next time.
            return {"absent": str(error)}
        if image is not None:
            image.parent.mkdir(parents=True, exist_ok=True)
            write(image, result.image, overwrite=True)
        cell = {"metrics": values, "reconstruct": seconds, "absent": None}
        write_json(path, cell)
        return cell

    def floors(self, reference: Reference) -> dict[str, float | None]:
        """The metrics between the two halves of a reference, which show the reference's noise; {} if it is one image.

        Squared metrics are left out, because with two halves they do not include this noise.
        """
        if len(reference.images) == 1:
            return {}
        path = self._path(["floors"], reference)
        if not path.exists():
            names = [name for name in self.metrics if not METRICS[name].squared]
            write_json(path, self._scores(names, *reference.images))
        return json.loads(path.read_text())

    def _scores(self, names: list[str], image: np.ndarray, *halves: np.ndarray) -> dict[str, float | None]:
        """The metrics ``names`` of an image; None for values that are not finite, like the PSNR of equal images."""
        values = scores(names, image, *halves, options=self.options)
        return {name: value if math.isfinite(value) else None for name, value in values.items()}

    def _path(self, parts: list, reference: Reference) -> Path:
        """The cache file of a result that depends on ``parts``, the reference, the metrics and the code."""
        parts = [*parts, reference.key, self.config.metrics, self.options, *self._code]
        return self.cache / f"{hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:32]}.json"


def absence(column: Column) -> str:
    """Why a column cannot be computed on this machine, "" if it can."""
    if column.method not in METHODS:
        return str(unknown_method(column.method))
    weights = column.options.get("weights", "")
    if weights and not Path(weights).is_file():
        return f"weights {weights}: no such file; train them first"
    lack = METHODS[column.method].missing()
    if lack and not (weights and "weights" in lack):
        return lack
    try:
        check_request(column.method, column.options)
    except NgptError as error:
        return str(error)
    return ""
