"""Whether ``ngpt render --time T --for auto`` keeps its word: its time, and its error compared to plain ``--time``.

    python -m bench.auto diffuse glossy SCENE.xml ... --times 10 30 60 [--cold] [--beside 1]

Each render runs in a process of its own. So does each denoising, by the method that the stack names (``ngpt:for``) or
by ``auto``. Seconds are wall-clock time from the start of `ngpt render` to the end of `ngpt denoise`, relative to the
requested time. Errors are trimmed relMSE against two halves of a reference. ``--cold``: no kernel is kept from another
run. ``--beside``: the number of other processes that are busy at the same time.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read, read_image
from ngpt.measure.metrics import relmse_trimmed

FORS = {"plain": [], "auto": ["--for", "auto"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--times", type=float, nargs="+", default=[10, 30, 60])
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--reference", type=float, default=60, metavar="SECONDS", help="of each half")
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--beside", type=int, default=0, metavar="N")
    parser.add_argument("--cache", type=Path, default=Path("out/auto"), help="folder of references")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/auto.json"))
    args = parser.parse_args()
    result = json.loads(args.output.read_text()) if args.output.exists() else {"benchmark": "auto", "rows": []}
    result["metadata"] = metadata("mitsuba")
    args.cache.mkdir(parents=True, exist_ok=True)
    for scene in args.scenes:
        halves = [reference(args, scene, half) for half in range(2)]
        for seconds in args.times:
            with beside(args.beside):
                row = {name: once(args, scene, seconds, more, halves) for name, more in FORS.items()}
            row |= {"scene": scene_name(scene), "time": seconds, "cold": args.cold, "beside": args.beside}
            result["rows"].append(row)
            save(args.output, result)
            print(line(row), flush=True)
    print(summary(result["rows"]))


def reference(args: argparse.Namespace, scene: str, half: int):
    """One of two halves, from the cache if it is there."""
    path = args.cache / f"{scene_name(scene)}-{args.size}-{half}.exr"
    if not path.exists():
        options = ["--sampler", "primal", "--time", str(args.reference), "--seed", str(1000 + half)]
        ngpt("render", scene, "-o", str(path), "--size", args.size, *options)
    return read(path)["primal"]


def once(args: argparse.Namespace, scene: str, seconds: float, more: list[str], halves) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        home = {"HOME": folder} if args.cold else {}
        start = time.perf_counter()
        stack, image = f"{folder}/a.exr", f"{folder}/b.exr"
        ngpt("render", scene, "-o", stack, "--size", args.size, "--time", str(seconds), *more, **home)
        about = read(stack).attributes
        method = about.get("ngpt:for", "auto")
        ngpt("denoise", stack, "-o", image, "--method", method, **home)
        took = time.perf_counter() - start
        error = relmse_trimmed(read_image(image), *halves)
    facts = {"sampler": about["ngpt:sampler"], "spp": int(about["ngpt:spp"]), "method": method}
    return facts | {"took": round(took / seconds, 3), "error": float(f"{error:.4g}")}


def ngpt(*words: str, **environment: str) -> None:
    subprocess.run([sys.executable, "-m", "ngpt", *words, "-q"], check=True, env=os.environ | environment)


@contextmanager
def beside(processes: int):
    """While in it, so many others are busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()


def line(row: dict) -> str:
    told = ["{}: {sampler} {spp} {method}, {took:.2f}".format(name, **row[name]) for name in FORS]
    where = f"{row['scene']}, {row['time']:g} s{', cold' if row['cold'] else ''}, beside {row['beside']}"
    return f"{where}: {'; '.join(told)}; error {row['auto']['error'] / row['plain']['error']:.2f}"


def summary(rows: list[dict]) -> str:
    """A line for each time and state of the machine: the longest run, and the error relative to plain --time."""
    lines = ["| seconds | kernels | other jobs | longest | error, mean | worst |", "|--:|---|--:|--:|--:|--:|"]
    for key in sorted({(row["time"], row["cold"], row["beside"]) for row in rows}):
        these = [row for row in rows if (row["time"], row["cold"], row["beside"]) == key]
        ratios = [row["auto"]["error"] / row["plain"]["error"] for row in these]
        longest = max(row["auto"]["took"] for row in these)
        mean = math.exp(statistics.mean(map(math.log, ratios)))
        kernels = "cold" if key[1] else "warm"
        lines.append(f"| {key[0]:g} | {kernels} | {key[2]} | {longest:.2f} | {mean:.2f} | {max(ratios):.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
