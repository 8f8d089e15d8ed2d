"""Curves of errors over samples or seconds: interpolated between measured points, and extrapolated a little.

A curve is the running minimum of its points, with straight lines between them on logarithmic axes. Beyond the points,
the nearest falling slope continues, but no steeper than ``STEEPEST``, and at most for a factor of ``REACH``. A mark
says how a value was found:

    ""      between measured points
    "~"     extrapolated by the nearest slope
    "<" ">" beyond the factor ``REACH``: the value is the one at this factor, and the true value is below or above it
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

from ngpt.measure.averages import geometric_mean

REACH = 4.0
# Squared errors fall as 1/samples. Steeper slopes are noise, as of two short renders that took nearly the same time.
STEEPEST = -1.0

# (samples or seconds, error)
Points = Sequence[tuple[float, float]]
Ratio = tuple[float, str]  # (value, mark)
_Segment = tuple[tuple[float, float], tuple[float, float]]


def first_at(error: float, points: Points) -> Ratio | None:
    """The samples or seconds at which a curve first falls to ``error``, and the mark.

    For a curve that never falls, it is the first point, as an upper bound, if its error is low enough; otherwise None.
    All numbers must be positive.
    """
    curve, falls = _curve(points)
    target, reach = math.log(error), math.log(REACH)
    if not falls:
        return (math.exp(curve[0][0]), "<") if curve and target >= curve[0][1] else None
    (first, highest), (last, lowest) = curve[0], curve[-1]
    if target > highest:
        x = first + (target - highest) / _outside(falls[0])
        return (math.exp(x), "~") if x >= first - reach else (math.exp(first - reach), "<")
    if target < lowest:
        x = last + (target - lowest) / _outside(falls[-1])
        return (math.exp(x), "~") if x <= last + reach else (math.exp(last + reach), ">")
    if target == highest:
        return math.exp(first), ""
    segment = next(segment for segment in falls if segment[1][1] <= target)
    return math.exp(segment[0][0] + (target - segment[0][1]) / _slope(segment)), ""


def error_at(x: float, points: Points) -> Ratio | None:
    """The error of a curve at ``x``, and the mark of a ratio with this error as the divisor.

    So the mark is ">" if the true error is below the returned one. None for fewer than two points. All numbers must be
    positive.
    """
    curve, falls = _curve(points)
    if len(curve) < 2:
        return None
    at, reach = math.log(x), math.log(REACH)
    (first, highest), (last, lowest) = curve[0], curve[-1]
    if at < first:
        error = highest + (max(at - first, -reach) * _outside(falls[0]) if falls else 0.0)
        return math.exp(error), "~" if at >= first - reach else "<"
    if at > last:
        error = lowest + (min(at - last, reach) * _outside(falls[-1]) if falls else 0.0)
        return math.exp(error), "~" if at <= last + reach else ">"
    a, b = next((a, b) for a, b in pairwise(curve) if at <= b[0])
    return math.exp(a[1] + (at - a[0]) * _slope((a, b))), ""


def over_least(error: float, x: float, curves: Iterable[Points]) -> Ratio | None:
    """An error over the least error of all curves at ``x``, with its mark; None if no curve has two points."""
    least = min((answer for points in curves if (answer := error_at(x, points))), default=None)
    return (error / least[0], least[1]) if least else None


def joined(marks: Iterable[str]) -> str:
    """The mark of a mean: "<" or ">" if all bounds are on that side; else "~" if there is any mark; else ""."""
    found = set(marks) - {""}
    bounds = found & {"<", ">"}
    return bounds.pop() if len(bounds) == 1 else "~" if found else ""


def marked(value: Ratio | None) -> str:
    """A ratio with its mark as text."""
    return f"{value[1]}{value[0]:.2f}" if value else "-"


def over(values: Sequence[Ratio | None]) -> str:
    """The geometric mean of the values, with its mark, as text; "-" if a value is missing."""
    known = [value for value in values if value]
    if len(known) < len(values):
        return "-"
    return marked((geometric_mean(value for value, _ in known), joined(mark for _, mark in known)))


def _curve(points: Points) -> tuple[list[tuple[float, float]], list[_Segment]]:
    """The running minimum and its falling segments, in logarithms."""
    curve: list[tuple[float, float]] = []
    for x, error in sorted(points):
        lowest = min(math.log(error), curve[-1][1] if curve else math.inf)
        if curve and math.log(x) == curve[-1][0]:
            continue  # Of several points at one place, the least error comes first.
        curve.append((math.log(x), lowest))
    return curve, [(a, b) for a, b in pairwise(curve) if b[1] < a[1]]


def _outside(segment: _Segment) -> float:
    """The slope of the extrapolation beyond a segment."""
    return max(_slope(segment), STEEPEST)


def _slope(segment: _Segment) -> float:
    """The slope of a segment, whose coordinates are logarithms."""
    (x0, e0), (x1, e1) = segment
    return (e1 - e0) / (x1 - x0)
