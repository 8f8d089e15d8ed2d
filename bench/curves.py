"""Learning curves of training runs as a picture: python -m bench.curves RUN... -o curves.svg

Each run's error on the views held out over its steps, relative to the primal's, both axes logarithmic.
"""

import argparse
import json
import math
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 640, 360, 70, 46, 16, 150
COLORS = ("#2f7fd6", "#d9772b", "#3a9a5b", "#b0489a", "#777777")


def read_curve(run: Path) -> tuple[list[tuple[int, float]], float]:
    """(step, error over the primal's) of a run, and the same of what its network starts from (NaN without)."""
    path = run / "log.jsonl"
    if not path.is_file():
        raise NgptError(f"{path}: no such file; pass the folders that train.py wrote")
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    scored = [entry for entry in entries if "relMSE" in entry]
    if not scored:
        raise NgptError(f"{path}: holds no validation; set data.validation, and run.validate below run.steps")
    base = scored[-1].get("relMSE base", math.nan) / scored[-1]["relMSE primal"]
    return [(entry["step"], entry["relMSE"] / entry["relMSE primal"]) for entry in scored], base


def draw(
    curves: dict[str, tuple[list[tuple[int, float]], float]],
    across: str = "training steps",
    up: str = "trimmed relMSE over the primal's",
) -> str:
    """An SVG of curves by name."""
    steps = [step for curve, _ in curves.values() for step, _ in curve]
    values = [v for curve, base in curves.values() for v in (*(e for _, e in curve), base) if math.isfinite(v)]
    x_range = math.log(min(steps)), math.log(max(steps)) + 1e-9
    y_range = math.log(min(values) / 1.2), math.log(max(values) * 1.2)

    def x(step: float) -> float:
        share = (math.log(step) - x_range[0]) / (x_range[1] - x_range[0])
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        share = (math.log(value) - y_range[0]) / (y_range[1] - y_range[0])
        return HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
    ]
    for value in _ticks(math.exp(y_range[0]), math.exp(y_range[1])):
        parts.append(f'<path d="M{LEFT} {y(value):.1f}H{WIDTH - RIGHT}" stroke="#dddddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.2g}</text>')
    for step in _ticks(min(steps), max(steps)):
        parts.append(f'<text x="{x(step):.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{step:g}</text>')
    for i, (name, (curve, base)) in enumerate(curves.items()):
        color = COLORS[i % len(COLORS)]
        path = "L".join(f"{x(step):.1f} {y(error):.1f}" for step, error in curve)
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts.append(f'<text x="{WIDTH - RIGHT + 8}" y="{y(curve[-1][1]) + 4:.1f}" fill="{color}">{name}</text>')
        if math.isfinite(base):
            parts.append(
                f'<path d="M{LEFT} {y(base):.1f}H{WIDTH - RIGHT}" stroke="{color}" stroke-dasharray="4 4"/>'
                f'<text x="{WIDTH - RIGHT + 8}" y="{y(base) + 4:.1f}" fill="{color}">its base</text>'
            )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 10}" text-anchor="middle">{across}</text>')
    parts.append(
        f'<text transform="translate(16 {(HEIGHT - BOTTOM + TOP) / 2}) rotate(-90)" text-anchor="middle">'
        f"{up}</text></svg>"
    )
    return "\n".join(parts) + "\n"


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between the two."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [m * 10.0**p for p in powers for m in (1, 2, 5) if low <= m * 10.0**p <= high]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders that train.py wrote")
    parser.add_argument("-o", "--output", required=True, metavar="SVG")
    args = parser.parse_args()
    svg = draw({run.name: read_curve(run) for run in args.runs})
    with atomic_output(args.output, overwrite=True) as temporary:
        temporary.write_text(svg)


if __name__ == "__main__":
    main()
