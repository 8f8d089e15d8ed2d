"""Decides which errors are worse than before, beyond noise, for ``bench.panel``.

A cell is a dict with "scene", "spp", "pipeline" and, for each name in LIMITS, a dict from seeds (as text) to values.
The ratio of a cell is the geometric mean of the new values over the old ones, over the seeds that both runs have.

The spread of a cell is the standard deviation of the logarithm of its values, over three seeds or more of the baseline.
Few seeds may lie close together by chance. So the spread is at least the usual spread of the same pipeline and number
of samples: the root of the median, over scenes, of the variances, corrected for the number of seeds. A change of
samplers gives the same seed other noise, so the logarithm of a ratio over n seeds has the standard deviation
spread * sqrt(2 / n). A change that keeps the samples has a smaller one.

Cells are judged, and also two kinds of means: over scenes for each pipeline and number of samples, and over numbers of
samples for each scene and pipeline. Means have smaller deviations, so they show small changes that occur everywhere. A
ratio is worse if it exceeds its limit and DEVIATIONS standard deviations. By chance, one ratio in 740 exceeds three
standard deviations, and a panel has 804. So ``bench.panel`` measures ratios that are worse with one seed again, with
all seeds of the baseline, before it fails.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from ngpt.errors import NgptError

LIMITS = {"error": 1.1, "FLIP": 1.05}
DEVIATIONS = 3.0
LEAST_SEEDS = 3
MEAN = "mean"

# (scene, number of samples, pipeline). MEAN stands in place of the entry that a mean is taken over.
Key = tuple[str, str, str]


class Judged(NamedTuple):
    """A ratio of new over old values; ``deviation`` is the standard deviation of its logarithm."""

    value: str
    key: Key
    ratio: float
    deviation: float

    @property
    def reach(self) -> float:
        """The largest ratio that noise explains."""
        return math.exp(DEVIATIONS * self.deviation)

    @property
    def worse(self) -> bool:
        return self.ratio > max(LIMITS[self.value], self.reach)


def joined(cells: Sequence[dict[str, Any]], further: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cells, with the seeds of the cells with the same keys in ``further`` added."""
    more = {key_of(cell): cell for cell in further}
    together = []
    for cell in cells:
        other = more.get(key_of(cell), {})
        together.append({name: x | other[name] if other and isinstance(x, dict) else x for name, x in cell.items()})
    return together


def key_of(cell: dict[str, Any]) -> Key:
    return cell["scene"], str(cell["spp"]), cell["pipeline"]


def compare(cells: Sequence[dict[str, Any]], before: Sequence[dict[str, Any]]) -> list[Judged]:
    """The ratios of the cells to the cells of the same scenes in ``before``; then the means.

    Raises NgptError if only one run has a cell, if runs share no seed, or if the earlier run has too few seeds.
    """
    scenes = {cell["scene"] for cell in cells}
    new = {key_of(cell): cell for cell in cells}
    old = {key_of(cell): cell for cell in before if cell["scene"] in scenes}
    if alone := sorted(new.keys() ^ old.keys()):
        where = "the numbers in git" if alone[0] in new else "this run"
        raise NgptError(
            f"{len(alone)} cells, such as {', '.join(alone[0])}, are not in {where}; if that is meant, "
            "make new numbers with --baseline"
        )
    judged = []
    for value in LIMITS:
        spread = spreads(before, value)
        single = []
        for key, cell in new.items():
            seeds = cell[value].keys() & old[key][value].keys()
            if not seeds:
                raise NgptError(f"{', '.join(key)}: no seed of this run is in the numbers in git; leave --seeds out")
            log = float(np.mean([math.log(cell[value][seed] / old[key][value][seed]) for seed in seeds]))
            single.append(Judged(value, key, math.exp(log), spread[key] * math.sqrt(2 / len(seeds))))
        judged += single
        for place in (0, 1):
            groups: dict[Key, list[Judged]] = {}
            for each in single:
                groups.setdefault((*each.key[:place], MEAN, *each.key[place + 1 :]), []).append(each)  # type: ignore[arg-type]
            judged += [mean_of(value, key, group) for key, group in groups.items() if len(group) > 1]
    return judged


def mean_of(value: str, key: Key, group: Sequence[Judged]) -> Judged:
    """The geometric mean of ratios with independent noise."""
    log = float(np.mean([math.log(each.ratio) for each in group]))
    return Judged(value, key, math.exp(log), math.hypot(*(each.deviation for each in group)) / len(group))


def spreads(cells: Sequence[dict[str, Any]], value: str) -> dict[Key, float]:
    """The spread of each cell; see the description of this module."""
    own: dict[Key, float] = {}
    others: dict[tuple[str, str], list[float]] = {}
    for cell in cells:
        seeds, key = len(cell[value]), key_of(cell)
        if seeds < LEAST_SEEDS:
            raise NgptError(
                f"{', '.join(key)}: {seeds} seeds in the numbers in git do not tell its noise; "
                f"make them with --baseline, of {LEAST_SEEDS} seeds or more"
            )
        variance = float(np.var(np.log(list(cell[value].values())), ddof=1))
        own[key] = math.sqrt(variance)
        # With Gaussian noise, variance * (seeds - 1) has a chi-squared distribution. It is divided by its median.
        others.setdefault(key[1:], []).append(variance * (seeds - 1) / float(chdtri(seeds - 1, 0.5)))
    usual = {place: math.sqrt(np.median(variances)) for place, variances in others.items()}
    return {key: max(each, usual[key[1:]]) for key, each in own.items()}
