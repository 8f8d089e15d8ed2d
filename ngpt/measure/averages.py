"""Averages of repeated measurements."""

import statistics
from collections.abc import Iterable

import numpy as np


def summary(values: list[float]) -> dict[str, float]:
    """The median, and the quartiles "low" and "high"."""
    low, median, high = statistics.quantiles(values, n=4, method="inclusive") if len(values) > 1 else values * 3
    return {"median": median, "low": low, "high": high}


def median(values: Iterable[float | None]) -> float | None:
    """The median of the values that are not None; None without any."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def geometric_mean(values: Iterable[float]) -> float:
    """The geometric mean. Values of 0 or less count as 1e-30."""
    return float(np.exp(np.mean(np.log(np.maximum(list(values), 1e-30)))))
