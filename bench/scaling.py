"""What more crops, or more steps, would buy: python -m bench.scaling CONFIG --out DIR --crops 20 40 80 --steps 500 1000

Trains the configuration on growing parts of its crops, each for ``run.steps`` steps, and on all of them for several
numbers of steps, each with a whole schedule. The crops of a smaller part are among those of a larger one; parts grow by
whole scenes, in an order that ``run.seed`` decides. The error is that of the scenes that ``data.validation`` holds out,
over the primal's; a power law is fitted to it. Runs that are there are continued: the command may be stopped.
"""

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import metadata, save
from bench.curves import read_curve
from ngpt.errors import NgptError
from ngpt.training.examples import split
from ngpt.training.folders import open_crops
from ngpt.training.loss import make_loss
from ngpt.training.settings import Settings, read_settings
from ngpt.training.trainer import Trainer


def part(crops: Sequence[Any], count: int, seed: int) -> list[Any]:
    """At least ``count`` of the crops, or all: those of as many scenes as it takes. A scene's crops stand together."""
    scenes = [list(group) for _, group in itertools.groupby(crops, key=lambda crop: crop.scene)]
    chosen: list[Any] = []
    for index in np.random.default_rng(seed).permutation(len(scenes)):
        if len(chosen) < count:
            chosen += scenes[index]
    return chosen


def train(settings: Settings, crops: Sequence[Any], held_out: Sequence[Any], out: Path) -> float:
    """The error over the primal's after the last step of the run in ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(settings, crops, held_out, make_loss(settings.loss), out)
    if trainer.checkpoint.exists():
        trainer.resume()
    if trainer.step < settings.run.steps and not trainer.run():
        raise NgptError(f"{out}: stopped at step {trainer.step}; the same command goes on")
    return read_curve(out)[0][-1][1]


def slope(points: Sequence[tuple[int, float]]) -> float | None:
    """The power of a law fitted to (number, error); None for fewer than two."""
    if len(points) < 2:
        return None
    numbers, errors = np.log(np.array(points, dtype=float)).T
    return float(np.polyfit(numbers, errors, 1)[0])


def table(name: str, points: Sequence[tuple[int, float]]) -> str:
    """Markdown: the errors, and by what factor the fit says that ten times as much changes them."""
    power = slope(points)
    rows = [f"| {name} | " + " | ".join(f"{number}" for number, _ in points) + " | power | ten times as many |"]
    rows += ["|---|" + "--:|" * (len(points) + 2)]
    cells = [f"{error:.4f}" for _, error in points] + (
        ["", ""] if power is None else [f"{power:.3f}", f"{10**power:.2f}"]
    )
    return "\n".join([*rows, "| error over the primal's | " + " | ".join(cells) + " |"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="settings of a training, as of train.py")
    parser.add_argument("--out", required=True, type=Path, help="folder of the runs")
    parser.add_argument("--crops", type=int, nargs="*", default=[], help="numbers of crops")
    parser.add_argument("--steps", type=int, nargs="*", default=[], help="numbers of steps, with all crops")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    parser.add_argument("-o", "--output", default="bench/results/scaling.json", metavar="JSON")
    args = parser.parse_args()

    settings = read_settings(args.config, args.set)
    every = [crop for folder in settings.data.folders for crop in open_crops(folder)]
    crops, held_out = split(every, settings.data.validation)
    if not held_out:
        raise NgptError("data.validation holds out no scene: there is nothing to measure errors on")
    by_crops, by_steps = [], []
    for count in sorted(args.crops):
        chosen = part(crops, count, settings.run.seed)
        by_crops.append((len(chosen), train(settings, chosen, held_out, args.out / f"crops-{count}")))
    for steps in sorted(args.steps):
        changed = read_settings(args.config, [*args.set, f"run.steps={steps}"])
        by_steps.append((steps, train(changed, crops, held_out, args.out / f"steps-{steps}")))
    result = {
        "metadata": metadata("torch"),
        "steps of each number of crops": settings.run.steps,
        "crops of each number of steps": len(crops),
        "crops held out": len(held_out),
        "by crops": by_crops,
        "by steps": by_steps,
        "powers": {"crops": slope(by_crops), "steps": slope(by_steps)},
    }
    save(args.output, result)
    for name, points in (("crops", by_crops), ("steps", by_steps)):
        if points:
            print(table(name, points) + "\n")


if __name__ == "__main__":
    main()
