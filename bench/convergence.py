"""How errors fall with samples per pixel, by the kind of ``points``.

    python -m bench.convergence diffuse glossy coffee.xml cornell-box.xml

renders each scene with `primal` and `gpt`, and takes the root of the mean squared error of the image against a
reference of many samples: of pixels, and of means over 8x8 pixels. The 2 % that are noisiest in the reference are left
out, so that single fireflies do not decide. It writes the errors and their slopes, fitted to logarithms, as JSON, a
picture of the geometric means over scenes, and the table of slopes into the page.
"""

import argparse
import math
import os
import statistics
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.common import blocks, metadata, renderer, save, write_page
from ngpt.evaluation.config import scene_name
from ngpt.system.writing import write_text

POINTS = ("sobol", "rounds", "independent")
SAMPLERS = {"primal": {"features": False}, "gpt": {}}
AREAS = {"pixels": lambda image: image, "blocks": blocks}
PAGE = Path("docs/samplers/points.md")
MARKS = "<!-- python -m bench.convergence -->", "<!-- convergence ends -->"
REFERENCE = 10_000  # its seed, which is none of the others
# Of the picture, in pixels
WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 640, 360, 70, 46, 16, 150
COLORS = ("#2f7fd6", "#d9772b", "#3a9a5b", "#b0489a", "#777777")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="scene files and built-in scenes")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--most", type=int, default=256, help="samples per pixel; 1, 2, 4 ... up to these are rendered")
    parser.add_argument("--reference", type=int, default=4096, help="samples per pixel of the reference")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/convergence.json"))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/convergence.svg"))
    args = parser.parse_args()
    load_scene, render_stack = renderer()
    counts = [1 << n for n in range(args.most.bit_length())]
    rows = []
    for name in args.scenes:
        scene = load_scene(os.fspath(name), tuple(args.size))
        stack = render_stack(scene, args.reference, REFERENCE, "primal", features=False)
        reference = stack["primal"]
        quiet = {area: quiet_part(of(stack["primal_var"])) for area, of in AREAS.items()}
        for sampler, options in SAMPLERS.items():
            for points in POINTS:
                found = {area: [] for area in AREAS}
                for spp in counts:
                    stacks = [
                        render_stack(scene, spp, seed, sampler, points=points, **options) for seed in range(args.seeds)
                    ]
                    for area, of in AREAS.items():
                        errors = np.array([of(stack["primal"] - reference) for stack in stacks], np.float64)
                        found[area].append(float(np.sqrt(np.square(errors[:, quiet[area]]).mean())))
                for area, errors in found.items():
                    row = {"scene": scene_name(name), "sampler": sampler, "points": points, "of": area}
                    rows.append(row | {"errors": errors, "slope": slope(counts, errors)})
                    print(*row.values(), f"{rows[-1]['slope']:.2f}", flush=True)
        settings = {"size": args.size, "reference": args.reference, "seeds": args.seeds, "spp": counts}
        result = {"benchmark": "convergence", "settings": settings, "metadata": metadata("mitsuba", "drjit")}
        save(args.output, result | {"rows": rows})
    write_text(args.picture, picture(rows, counts))
    write_page(PAGE, table(rows), MARKS)


def quiet_part(variance: np.ndarray) -> np.ndarray:
    """Where (H, W, C) is not among the largest; the same for all numbers of samples, or slopes would change."""
    total = variance.sum(axis=-1)
    return total <= np.quantile(total, 0.98)


def slope(counts: list[int], errors: list[float]) -> float:
    return float(np.polyfit(np.log(counts), np.log(errors), 1)[0])


def picture(rows: list[dict], counts: list[int]) -> str:
    """Errors of `primal` relative to independent points at one sample per pixel, geometric means over scenes."""
    found = {}
    for area in AREAS:
        # Rounds would lie on top of one net; the table has them
        for points in ("sobol", "independent"):
            of_scenes = [
                np.divide(row["errors"], base["errors"][0])
                for row, base in zip(
                    of(rows, sampler="primal", points=points, of=area),
                    of(rows, sampler="primal", points="independent", of="pixels"),
                    strict=True,
                )
            ]
            means = np.exp(np.mean(np.log(of_scenes), axis=0))
            found[f"{points}, {area}"] = list(zip(counts, means, strict=True))
    return drawn(found, "samples per pixel", "RMSE over pixels of 1 sample")


def drawn(curves: dict[str, list[tuple[int, float]]], across: str, up: str) -> str:
    """An SVG of curves by name, both axes logarithmic."""
    steps = [step for curve in curves.values() for step, _ in curve]
    values = [value for curve in curves.values() for _, value in curve]
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
    for i, (name, curve) in enumerate(curves.items()):
        color = COLORS[i % len(COLORS)]
        path = "L".join(f"{x(step):.1f} {y(error):.1f}" for step, error in curve)
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts.append(f'<text x="{WIDTH - RIGHT + 8}" y="{y(curve[-1][1]) + 4:.1f}" fill="{color}">{name}</text>')
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


def of(rows: list[dict], **wanted: str) -> Iterator[dict]:
    """The rows that have these values."""
    return (row for row in rows if wanted.items() <= row.items())


def table(rows: list[dict]) -> str:
    """Slopes of pixels and of blocks, and how many times as large the error of independent points is in the end."""
    lines = ["| scene, sampler | " + " | ".join(f"`{points}`" for points in POINTS) + " | error at the end |"]
    lines.append("|---|" + "--:|" * (len(POINTS) + 1))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for scene in scenes:
        for sampler in SAMPLERS:
            cells = {points: list(of(rows, scene=scene, sampler=sampler, points=points)) for points in POINTS}
            slopes = [", ".join(f"{row['slope']:.2f}" for row in cells[points]) for points in POINTS]
            pairs = zip(cells["sobol"], cells["independent"], strict=True)
            ends = ", ".join(f"{one['errors'][-1] / other['errors'][-1]:.2f}" for one, other in pairs)
            lines.append(f"| `{scene}`, `{sampler}` | {' | '.join(slopes)} | {ends} |")
    mean = [
        ", ".join(f"{statistics.mean(row['slope'] for row in of(rows, points=points, of=area)):.2f}" for area in AREAS)
        for points in POINTS
    ]
    return "\n".join([*lines, f"| mean | {' | '.join(mean)} | |"])


if __name__ == "__main__":
    main()
