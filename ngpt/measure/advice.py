"""Which method and how many samples: from measurements on other scenes and a pilot of this one.

The table holds, for each scene that was measured, what a pilot sees of it and the error of each method at each sample
count. Over these scenes each method m has a law

    log error_m = log noise - log n + a_m + b_m log n + c_m log noise + d_m log gain

for n samples, fitted by ridge regression: ``noise`` is the relative variance of a sample, ``gain`` how much less
variance gradients have than independent differences. How well it does is judged by scenes left out of the fit.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from ngpt.errors import NgptError
from ngpt.measure.metrics import EPSILON
from ngpt.repair import variance_of_primal
from ngpt.stack import GradientStack

# Of the ridge, in scenes' worth of evidence: a law starts as that of plain averaging.
_RIDGE = 0.5
LARGEST_SPP = 1 << 20


@dataclass(frozen=True)
class Advice:
    """A method, its samples, and what to expect.

    ``spp``      samples per pixel of the kind of stack the method is given (``stack``)
    ``seconds``  to render and reconstruct, kernels compiled
    ``error``    expected, with ``low`` and ``high``: a standard deviation either way, as scenes left out showed it
    ``sure``     probability that it is no worse than the best of the other methods
    """

    method: str
    stack: str
    spp: int
    seconds: float
    error: float
    low: float
    high: float
    sure: float


def describe(stack: GradientStack) -> dict[str, float]:
    """What a pilot, a gradient stack with variances, tells of a scene: ``noise`` and ``gain``, both positive.

    ``noise``  that of ``relative_noise``
    ``gain``   variance of independent differences of neighbours over that of the gradients, summed over the image
    """
    stack.require("primal_var", "dx_var", "dy_var", why="advice")
    # Gradients are compared with what they are the differences of, which is not all light that is noise.
    variance = np.nan_to_num(stack["primal_var"], nan=0.0, posinf=0.0)
    independent = gradient = 0.0
    for name, here, there in (("dx_var", np.s_[:, :-1], np.s_[:, 1:]), ("dy_var", np.s_[:-1], np.s_[1:])):
        sums, ours = (variance[here] + variance[there]).sum(axis=-1), np.nan_to_num(stack[name][here]).sum(axis=-1)
        # A few fireflies would decide both sums.
        kept = sums <= np.quantile(sums, 0.99)
        independent += float(sums[kept].sum(dtype=np.float64))
        gradient += float(ours[kept].sum(dtype=np.float64))
    gain = independent / gradient if gradient > 0 and independent > 0 else 1.0
    return {"noise": relative_noise(stack), "gain": gain}


def relative_noise(stack: GradientStack) -> float:
    """Mean over pixels of σ² / (r² + 1e-3), σ² the variance of one sample and r the primal, averaged over 7x7 pixels;
    without the largest 1 % of the pixels. The ``stack`` needs the variance of its primal."""
    stack.require("primal_var", why="advice")
    spp = float(stack.attributes.get("ngpt:spp", 1))
    primal, whole = (
        np.nan_to_num(layer, nan=0.0, posinf=0.0) for layer in (stack["primal"], variance_of_primal(stack))
    )
    mean = uniform_filter(primal.astype(np.float64), (7, 7, 1))
    local = uniform_filter(whole.astype(np.float64), (7, 7, 1))
    relative = np.sort((local / (mean**2 + EPSILON)).mean(axis=-1), axis=None)
    return max(float(relative[: max(1, int(0.99 * relative.size))].mean()) * spp, 1e-12)


def make_table(results: dict[str, Any]) -> dict[str, Any]:
    """The table of advice from what an evaluation wrote (results.json).

    In it are methods that are there on all scenes, with the usual sampler for their kind of stack, as the pilot is.
    """
    primary, scenes = results["primary"], []
    kinds = {name: entry["stack"] for name, entry in results["methods"].items() if entry["render"] == entry["stack"]}
    for name, entry in results["scenes"].items():
        if entry.get("absent") or not entry.get("pilot"):
            continue
        width, height = entry["size"]
        methods: dict[str, dict[str, list[float]]] = {}
        for row in results["summary"]:
            if row["scene"] == name and row["method"] in kinds and (row["error"] or 0) > 0:
                law = methods.setdefault(row["method"], {"spp": [], "error": [], "reconstruct": []})
                used = [c["spp used"] for c in results["cells"] if _same(c, row) and not c["absent"]]
                law["spp"].append(float(np.median(used)))
                law["error"].append(row["error"])
                law["reconstruct"].append(row["seconds"]["reconstruct"] / (width * height))
        cost = {kind: entry["cost"][kind]["median"] / (width * height) for kind in sorted(set(kinds.values()))}
        scenes.append({"scene": name, **entry["pilot"], "cost": cost, "methods": methods})
    shared = [m for m in kinds if scenes and all(m in scene["methods"] for scene in scenes)]
    for scene in scenes:
        scene["methods"] = {m: scene["methods"][m] for m in shared}
    if len(scenes) < 3 or not shared:
        raise NgptError(f"advice needs measurements of at least 3 scenes with a method in common; got {len(scenes)}")
    # What to ask ``ngpt denoise`` for, where it is not the method of that name as it is.
    entries = {m: results["methods"][m] for m in shared}
    calls = {m: {"method": e.get("method", m), "options": e.get("options") or {}} for m, e in entries.items()}
    return {
        "metric": primary,
        "methods": {m: kinds[m] for m in shared},
        "calls": {m: entry for m, entry in calls.items() if entry != {"method": m, "options": {}}},
        "scenes": scenes,
        "made by": results["command"],
    }


def _same(cell: dict, row: dict) -> bool:
    return all(cell[key] == row[key] for key in ("scene", "spp", "method"))


def read_table(path: str | Path | None = None) -> dict[str, Any]:
    """The table in a file, or the one that comes with the package."""
    source = Path(path) if path else package_files("ngpt.measure") / "advice.json"
    try:
        table = json.loads(source.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise NgptError(f"{source}: cannot be read: {error}; python eval.py --advice FILE makes one") from error
    if not isinstance(table, dict) or not {"methods", "scenes"} <= table.keys():
        raise NgptError(f"{source}: not a table of advice; python eval.py --advice FILE makes one")
    return table


class Laws:
    """The laws of a table's methods, fitted without the scene ``left_out``."""

    def __init__(self, table: dict[str, Any], left_out: str = ""):
        self.table = table
        self.scenes = [scene for scene in table["scenes"] if scene["scene"] != left_out]
        self.middle = np.mean([_pilot(scene) for scene in self.scenes], axis=0)
        self.weights = {m: self._fit(m) for m in table["methods"]}

    def _fit(self, method: str) -> np.ndarray:
        rows, targets = [], []
        for scene in self.scenes:
            law = scene["methods"][method]
            for spp, error in zip(law["spp"], law["error"], strict=True):
                rows.append(self._row(scene, spp))
                targets.append(math.log(error) - math.log(scene["noise"] / spp))
        x, y = np.array(rows), np.array(targets)
        penalty = np.diag([0.0, 1.0, 1.0, 1.0]) * _RIDGE * len(y) / len(self.scenes)
        return np.linalg.solve(x.T @ x + penalty + 1e-9 * np.eye(4), x.T @ y)

    def _row(self, pilot: dict[str, Any], spp: float) -> np.ndarray:
        return np.array([1.0, math.log(spp) - 3.0, *(_pilot(pilot) - self.middle)])

    def log_error(self, method: str, pilot: dict[str, Any], spp: float) -> float:
        return math.log(pilot["noise"] / spp) + float(self._row(pilot, spp) @ self.weights[method])

    def reconstruct(self, method: str) -> float:
        """Seconds per pixel, the median of what was measured; the table's machine stands in for the reader's."""
        return float(np.median([s for scene in self.scenes for s in scene["methods"][method]["reconstruct"]]))


def _pilot(scene: dict[str, Any]) -> np.ndarray:
    return np.log([scene["noise"], scene["gain"]])


def advise(
    table: dict[str, Any],
    pilot: dict[str, float],
    cost: dict[str, float],
    pixels: int,
    *,
    seconds: float | None = None,
    error: float | None = None,
    left_out: str = "",
) -> list[Advice]:
    """All methods of the table, the one to take first.

    ``pilot`` is what ``describe`` gives, ``cost`` seconds per sample and pixel by kind of stack; methods for stacks of
    another kind are left out. With ``seconds`` each method has the samples that fit into them, and the lowest error
    comes first; with ``error`` those that reach it, and the shortest time comes first. Raises NgptError unless one of
    the two is given and something fits.
    """
    if (seconds is None) == (error is None):
        raise NgptError("say either how many seconds there are or which error to reach")
    laws = Laws(table, left_out)
    spread = residuals(table, left_out)
    found = []
    usable = {method: stack for method, stack in table["methods"].items() if stack in cost}
    for method, stack in usable.items():
        each, after = cost[stack] * pixels, laws.reconstruct(method) * pixels
        if seconds is not None:
            spp = int((seconds - after) / each)
        else:
            assert error is not None
            spp = _samples(laws, method, pilot, error)
        if spp >= 2 and spp < LARGEST_SPP:
            expected = math.exp(laws.log_error(method, pilot, spp))
            deviation = math.exp(float(np.std(spread[method])))
            found.append((method, stack, spp, after + spp * each, expected, expected / deviation, expected * deviation))
    if not found:
        cheapest = min((2 * cost[s] + laws.reconstruct(m)) * pixels for m, s in usable.items())
        raise NgptError(
            f"nothing fits into {seconds:g} s: the cheapest takes {cheapest:.2g} s"
            if seconds is not None
            else f"no method reaches an error of {error:g} with fewer than {LARGEST_SPP} samples; ask for more"
        )
    found.sort(key=lambda f: f[4] if seconds is not None else f[3])
    return [Advice(*f, sure=_sure(f, found, spread, seconds is not None)) for f in found]


def _samples(laws: Laws, method: str, pilot: dict[str, float], error: float) -> int:
    """The fewest samples whose expected error is at most ``error``; LARGEST_SPP where none are enough."""
    low, high = 2, LARGEST_SPP
    while low < high:
        middle = (low + high) // 2
        if laws.log_error(method, pilot, middle) <= math.log(error):
            high = middle
        else:
            low = middle + 1
    return low


def _sure(chosen: tuple, found: list[tuple], spread: dict[str, np.ndarray], by_error: bool) -> float:
    """The probability that no other is better: for each rival a normal law of the difference of their residuals.

    The difference, since what makes a scene hard is hard for all; the most dangerous rival counts.
    """
    place = 4 if by_error else 3
    least = 1.0
    for other in found:
        if other[0] != chosen[0]:
            gap = math.log(other[place] / chosen[place])
            deviation = float(np.sqrt(np.mean((spread[other[0]] - spread[chosen[0]]) ** 2))) + 1e-9
            least = min(least, 0.5 * math.erfc(-gap / deviation / math.sqrt(2)))
    return least


def residuals(table: dict[str, Any], left_out: str = "") -> dict[str, np.ndarray]:
    """For each method log measured - log expected error of each scene by laws fitted without it, mean over counts."""
    scenes = [scene for scene in table["scenes"] if scene["scene"] != left_out]
    subset = {**table, "scenes": scenes}
    result: dict[str, list[float]] = {method: [] for method in table["methods"]}
    for scene in scenes:
        laws = Laws(subset, scene["scene"])
        for method in table["methods"]:
            law = scene["methods"][method]
            pairs = zip(law["spp"], law["error"], strict=True)
            result[method].append(float(np.mean([math.log(e) - laws.log_error(method, scene, n) for n, e in pairs])))
    return {method: np.array(values) for method, values in result.items()}
