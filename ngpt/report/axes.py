"""Axes of a picture drawn by hand as SVG: logarithmic, or linear from left to right."""

import math
from dataclasses import dataclass

from ngpt.system.text import markup


@dataclass(frozen=True)
class Axes:
    """Two logarithmic axes with their ranges, in a picture of ``width`` x ``height`` units; ``even``: x is linear."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    width: int = 680
    height: int = 420
    left: int = 70
    margin: int = 160  # at the right, for names
    even: bool = False

    @property
    def right(self) -> int:
        return self.width - self.margin

    @property
    def bottom(self) -> int:
        return self.height - 46

    def x(self, value: float) -> float:
        low, high = self.x_range
        share = (value - low) / (high - low) if self.even else _share(value, self.x_range)
        return self.left + share * (self.right - self.left)

    def y(self, value: float) -> float:
        return self.bottom - _share(value, self.y_range) * (self.bottom - 30)

    def frame(self, x_label: str, y_label: str, title: str) -> list[str]:
        """The beginning of the SVG: grid, numbers, labels."""
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
            'font-family="sans-serif" font-size="12">',
            f'<rect width="{self.width}" height="{self.height}" fill="white"/>',
            f'<text x="{self.left}" y="18" font-size="14">{markup(title)}</text>',
        ]
        for value in ticks(*self.y_range):
            parts.append(f'<path d="M{self.left} {self.y(value):.1f}H{self.right}" stroke="#e4e4e4"/>')
            parts.append(f'<text x="{self.left - 6}" y="{self.y(value) + 4:.1f}" text-anchor="end">{value:.3g}</text>')
        for value in (even_ticks if self.even else ticks)(*self.x_range):
            parts.append(f'<path d="M{self.x(value):.1f} 30V{self.bottom}" stroke="#e4e4e4"/>')
            parts.append(f'<text x="{self.x(value):.1f}" y="{self.bottom + 16}" text-anchor="middle">{value:g}</text>')
        middle = (self.left + self.right) / 2
        parts.append(f'<text x="{middle}" y="{self.height - 10}" text-anchor="middle">{markup(x_label)}</text>')
        parts.append(
            f'<text transform="translate(16 {(self.bottom + 30) / 2}) rotate(-90)" text-anchor="middle">'
            f"{markup(y_label)}</text>"
        )
        return parts

    def legend(self, names: list[tuple[str, str, str]]) -> list[str]:
        """Names with their colours and dashes, at the right."""
        parts = []
        for i, (name, color, dash) in enumerate(names):
            y = 40 + 17 * i
            dashes = f' stroke-dasharray="{dash}"' if dash else ""
            parts.append(f'<path d="M{self.right + 10} {y}h18" stroke="{color}" stroke-width="3"{dashes}/>')
            parts.append(f'<text x="{self.right + 34}" y="{y + 4}">{markup(name)}</text>')
        return parts


def ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from ``low`` to ``high``. If these are too many, only powers of ten; if fewer than
    two, evenly spaced numbers."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if math.log10(high / low) < 3.5 else (1,)
    found = [value for p in powers for m in steps if low <= (value := m * 10.0**p) <= high]
    return found if len(found) > 1 or low == high else even_ticks(low, high)


def even_ticks(low: float, high: float) -> list[float]:
    """Four to ten numbers between the two, 1, 2 or 5 times a power of ten apart; ``low`` < ``high``."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4))
    step = next(m * power for m in (5, 2, 1) if m * power <= (high - low) / 4)
    return [round(n * step, 12) for n in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _share(value: float, limits: tuple[float, float]) -> float:
    low, high = (math.log(limit) for limit in limits)
    return (math.log(value) - low) / (high - low) if high > low else 0.5
