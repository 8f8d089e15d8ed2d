"""Curves over steps or hours as a small SVG picture: x is linear, y logarithmic."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle

from ngpt.system.text import markup

COLORS = ("#2f7fd6", "#d9772b", "#3a9a5b", "#b0489a", "#7a6a3a", "#777777")
# The most points of a curve. If a curve has more, groups of neighbours are replaced by their mean.
MOST = 300
# The picture and the area of the curves in it, in units of SVG. The margin at the right depends on the names there.
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 560, 280, 64, 30, 234

Curve = Sequence[tuple[float, float]]


def curves(across: str, lines: Mapping[str, Curve]) -> str:
    """An SVG of named curves of (x, y), with ``across`` as the label of x. Points whose y is not above 0 are left out.

    Returns "" if there is nothing to draw.
    """
    drawn = {name: points for name, line in lines.items() if (points := _thinned(line))}
    if not drawn:
        return ""
    xs = [x for line in drawn.values() for x, _ in line]
    ys = [y for line in drawn.values() for _, y in line]
    low, high = min(0.0, *xs), max(xs) or 1.0
    least, most = min(ys) / 1.15, max(ys) * 1.15
    names = [name if len(name) <= 28 else f"...{name[-26:]}" for name in drawn] if len(drawn) > 1 else []
    right = _WIDTH - min(24 + (7 * max(map(len, drawn)) + 34 if names else 0), 240)

    def across_at(x: float) -> float:
        return _LEFT + (x - low) / (high - low) * (right - _LEFT)

    def down_at(y: float) -> float:
        return _BOTTOM - math.log(y / least) / math.log(most / least) * (_BOTTOM - _TOP)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif" '
        'font-size="12">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        f'<text x="{(_LEFT + right) / 2}" y="{_HEIGHT - 10}" text-anchor="middle">{markup(across)}</text>',
    ]
    for value in _ticks(least, most):
        parts.append(f'<path d="M{_LEFT} {down_at(value):.1f}H{right}" stroke="#e4e4e4"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{down_at(value) + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    for value in _even_ticks(low, high):
        parts.append(f'<path d="M{across_at(value):.1f} {_TOP}V{_BOTTOM}" stroke="#e4e4e4"/>')
        parts.append(f'<text x="{across_at(value):.1f}" y="{_BOTTOM + 16}" text-anchor="middle">{value:g}</text>')
    for color, line in zip(cycle(COLORS), drawn.values(), strict=False):
        path = "L".join(f"{across_at(x):.1f} {down_at(y):.1f}" for x, y in line)
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2" stroke-linejoin="round"/>')
        # A line of a single point would be invisible without a dot.
        x, y = line[-1]
        parts.append(f'<circle cx="{across_at(x):.1f}" cy="{down_at(y):.1f}" r="3" fill="{color}"/>')
    for i, (color, name) in enumerate(zip(cycle(COLORS), names, strict=False)):
        parts.append(f'<path d="M{right + 10} {40 + 17 * i}h18" stroke="{color}" stroke-width="3"/>')
        parts.append(f'<text x="{right + 34}" y="{44 + 17 * i}">{markup(name)}</text>')
    return "\n".join([*parts, "</svg>"])


def _ticks(low: float, high: float) -> list[float]:
    """The numbers from ``low`` to ``high`` that are 1, 2 or 5 times a power of ten.

    Over more than 3.5 decades, only the powers of ten are returned. If there are fewer than two such numbers, evenly
    spaced numbers are returned instead.
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if math.log10(high / low) < 3.5 else (1,)
    found = [value for p in powers for m in steps if low <= (value := m * 10.0**p) <= high]
    return found if len(found) > 1 else _even_ticks(low, high)


def _even_ticks(low: float, high: float) -> list[float]:
    """Four to ten numbers from ``low`` to ``high``, at steps of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4))
    step = next(m * power for m in (5, 2, 1) if m * power <= (high - low) / 4)
    return [round(n * step, 12) for n in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _thinned(line: Curve) -> list[tuple[float, float]]:
    """At most ``MOST`` points, each the mean of a group of neighbours."""
    points = [(x, y) for x, y in line if math.isfinite(y) and y > 0]
    group = math.ceil(len(points) / MOST)
    parts = [points[i : i + group] for i in range(0, len(points), group)] if points else []
    return [(part[-1][0], sum(y for _, y in part) / len(part)) for part in parts]
