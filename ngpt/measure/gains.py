"""What one more layer would buy: errors of what ``auto`` takes, by the layers of a stack and whether OIDN is installed.

The errors are measured (layers.json, by ``python -m bench.layers``; docs/lab/RESULTS.md has them as a table): geometric
means of the trimmed relMSE over the four built-in scenes, of stacks of the same samples with fewer or more layers.
"""

import json
from collections.abc import Callable, Collection, Container, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files as package_files
from itertools import combinations
from typing import Any

from ngpt.layers import LAYERS
from ngpt.measure.averages import geometric_mean
from ngpt.methods import METHODS, choose

# Layers that a renderer gives together, and a package.
GROUPS = (("albedo",), ("normal",), ("depth",), ("primal_var",), ("dx", "dy"), ("dx_var", "dy_var"))
OIDN = ("OIDN",)
NEED_OIDN = ("ngpt-combine", "ngpt-primal", "oidn")

# An addition counts where it leaves so much of the error at most, and so much of what a part of it would leave.
WORTH = 0.95


@dataclass(frozen=True)
class Gain:
    """What an addition to a stack, or to the machine, would buy.

    ``add``     layers, and "OIDN" for the package
    ``method``  the method that ``auto`` would take then
    ``error``   by samples per pixel: the error divided by the error of the method that ``auto`` takes now
    """

    add: tuple[str, ...]
    method: str
    error: dict[int, float]


def gains(layers: Container[str]) -> list[Gain]:
    """The smallest additions with which ``auto`` leaves less error: OIDN first, then the fewest layers."""
    spp, errors = read_errors()
    now = choose(layers)
    before = errors.get((now, used(now, layers)))
    groups = [group for group in GROUPS if any(name not in layers for name in group)]
    found: list[Gain] = []
    if before is None:
        return found
    # OIDN only by itself: once it is installed, this gives a new answer. Networks with it need an installed runtime.
    package = [(OIDN,)] if METHODS["oidn"].missing() and not METHODS["ngpt-fast"].missing() else []
    for added in [*package, *_subsets(groups)]:
        more = {name for group in added for name in group}
        union = {name for name in LAYERS if name in layers or name in more}
        method = choose(union, usable(True) if "OIDN" in more else None)
        after = errors.get((method, used(method, union)))
        if after is None:
            continue
        gain = Gain(tuple(name for group in added for name in group if name not in layers), method, {})
        gain.error.update((n, float(a / b)) for n, a, b in zip(spp, after, before, strict=True))
        best = min((_mean(g) for g in found if set(g.add) < set(gain.add)), default=1.0)
        if _mean(gain) < WORTH * best:
            found.append(gain)
    return found


def used(method: str, layers: Container[str]) -> tuple[str, ...]:
    """The layers of those given that a method takes, in the order of the contract."""
    entry = METHODS[method]
    return tuple(name for name in LAYERS if name in layers and name in (*entry.needs, *entry.uses, *entry.estimates))


def usable(oidn: bool) -> Callable[[str], bool]:
    """Which methods ``choose`` may take where all packages are installed, with OIDN or without."""
    return lambda name: oidn or name not in NEED_OIDN


def cases() -> dict[tuple[str, tuple[str, ...]], None]:
    """Each method that ``auto`` takes of some layers, and which it takes of them; with OIDN and without."""
    found: dict[tuple[str, tuple[str, ...]], None] = {}
    for added in [(), *_subsets(GROUPS)]:
        layers = {"primal", *(name for group in added for name in group)}
        for oidn in (True, False):
            method = choose(layers, usable(oidn))
            found[method, used(method, layers)] = None
    return found


@lru_cache(maxsize=1)
def read_errors() -> tuple[tuple[int, ...], dict[tuple[str, tuple[str, ...]], tuple[float, ...]]]:
    """The sample counts, and the error at each of them by method and the layers it takes."""
    table: dict[str, Any] = json.loads((package_files("ngpt.measure") / "layers.json").read_text("utf-8"))
    rows = {(row["method"], tuple(row["layers"])): tuple(row["error"]) for row in table["rows"]}
    return tuple(table["spp"]), rows


def _subsets(groups: Collection[tuple[str, ...]]) -> Iterator[tuple[tuple[str, ...], ...]]:
    for size in range(1, len(groups) + 1):
        yield from combinations(groups, size)


def _mean(gain: Gain) -> float:
    return geometric_mean(gain.error.values())
