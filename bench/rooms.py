"""Compares weights to the shipped weights, in rooms outside of all training sets, at equal samples:

    python -m bench.rooms SCENE.xml ... --weights ARM=FILE ARM=FILE ... [--start FILE] --cache FOLDER

The files of one ARM are its seeds. Error is the trimmed relMSE against two halves of a path-traced reference. FLIP is
measured against the mean of the halves. Brightness is the mean of the image over the mean of the reference. Error and
FLIP are ratios to ``--start``, geometric means over the rooms, each followed by its standard error over seeds and
rooms. Stacks are rendered with one seed, as `ngpt render` renders them: where it pays, paths share their tails.
"""

import argparse
import json
import statistics
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, rendered, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.flip import flip
from ngpt.measure.images import middle
from ngpt.measure.metrics import relmse_trimmed

START = "start"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--weights", nargs="+", default=[], metavar="ARM=FILE")
    parser.add_argument("--start", default="export/weights/ngpt-combine.safetensors", metavar="FILE")
    parser.add_argument("--sampler", default="gpt", help="of the stacks, such as primal for ngpt-primal")
    parser.add_argument("--size", type=int, nargs=2, default=[320, 180])
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--reference", type=int, default=384, metavar="SPP", help="of each half")
    parser.add_argument("--cache", type=Path, default=Path("out/rooms"), help="folder of renders")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/rooms.json"))
    args = parser.parse_args()
    about_run = {"metadata": metadata("torch", "mitsuba"), "sampler": args.sampler, "size": args.size}
    given = [(START, args.start), *(arm.split("=", 1) for arm in args.weights)]
    rows = json.loads(args.output.read_text())["rows"] if args.output.exists() else []
    for scene in args.scenes:
        halves = tuple(
            rendered(args.cache, args.size, scene, args.reference, "primal", seed, unbiased=True)["primal"]
            for seed in (1000, 1001)
        )
        for spp in args.spp:
            stack = rendered(args.cache, args.size, scene, spp, args.sampler, 1, unbiased=False)
            for arm, path in given:
                about = {"room": scene_name(scene), "spp": spp, "arm": arm, "weights": Path(path).as_posix()}
                if not any(about.items() <= row.items() for row in rows):
                    rows.append(about | judged(ngpt.denoise(stack, "ngpt", weights=str(path)), halves))
                    save(args.output, about_run | {"rows": rows})
    print(table(rows, args.spp))


def judged(image: np.ndarray, halves: tuple[np.ndarray, ...]) -> dict[str, float]:
    reference = middle(halves)
    values = {"error": relmse_trimmed(image, *halves), "flip": flip(image, reference)[0]}
    # Without the brightest pixels, which a few samples decide.
    dark = reference <= np.quantile(reference, 0.999)
    values["brightness"] = float(image[dark].mean(dtype=np.float64) / reference[dark].mean(dtype=np.float64))
    return {name: float(f"{value:.5g}") for name, value in values.items()}


def table(rows: list[dict], counts: list[int]) -> str:
    """Markdown: a line for each arm, error / FLIP / brightness at each number of samples."""
    lines = ["| weights | seeds |" + "".join(f" {spp} spp: error | FLIP | brightness |" for spp in counts)]
    lines.append("|---|--:|" + "--:|--:|--:|" * len(counts))
    for arm in dict.fromkeys(row["arm"] for row in rows):
        these = [row for row in rows if row["arm"] == arm]
        cells = [cell for spp in counts for cell in _cells([row for row in these if row["spp"] == spp], rows)]
        lines.append(f"| {arm} | {len({row['weights'] for row in these})} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cells(these: list[dict], rows: list[dict]) -> list[str]:
    """Error and FLIP relative to the start, each with its standard error, and the brightness."""
    cells = []
    for name in ("error", "flip"):
        logs = [np.log(row[name] / _start(row, rows)[name]) for row in these]
        spread = statistics.stdev(logs) / len(logs) ** 0.5 if len(logs) > 1 else float("nan")
        cells.append(f"{np.exp(np.mean(logs)):.3f} ± {spread:.3f}")
    return [*cells, f"{statistics.mean(row['brightness'] for row in these):.3f}"]


def _start(row: dict, rows: list[dict]) -> dict:
    same = {"room": row["room"], "spp": row["spp"], "arm": START}
    return next(other for other in rows if same.items() <= other.items())


if __name__ == "__main__":
    main()
