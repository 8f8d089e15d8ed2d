"""How errors fall with samples per pixel, by the kind of ``points``.

    python -m bench.convergence diffuse glossy coffee.xml cornell-box.xml

renders each scene with `primal` and `gpt`, and takes the root of the mean squared error of the image against a
reference of many samples: of pixels, and of means over 8x8 pixels. The 2 % that are noisiest in the reference are left
out, so that single fireflies do not decide. It writes the errors and their slopes, fitted to logarithms, as JSON, a
picture of the geometric means over scenes, and the table of slopes into the page.
"""

import argparse
import os
import statistics
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench import curves
from bench.claims import blocks
from bench.common import metadata, save, write_page
from ngpt.evaluation.config import scene_name
from ngpt.system.files import atomic_output

POINTS = ("sobol", "rounds", "independent")
SAMPLERS = {"primal": {"features": False}, "gpt": {}}
AREAS = {"pixels": lambda image: image, "blocks": blocks}
PAGE = Path("docs/samplers/points.md")
MARKS = "<!-- python -m bench.convergence -->", "<!-- convergence ends -->"
REFERENCE = 10_000  # its seed, which is none of the others


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
    from data_gen.backend import use_variant
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    use_variant("llvm_ad_rgb")
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
    with atomic_output(args.picture, overwrite=True) as temporary:
        temporary.write_text(picture(rows, counts))
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
    return curves.draw(found, "samples per pixel", "RMSE over pixels of 1 sample")


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
