"""The effect of each part of the paper's network and loss, at the scale of a CPU: the ablations of NGPT's section 4.4.

    python -m bench.ablations --data SET ... --apart SCENE ... --out DIR

Trains configs/ablations.toml and its variants on the same crops, for the same number of steps, from the same seed.
Measures them on all inputs of the scenes whose names begin with one of --apart: geometric means of trimmed relMSE
(without the noise of references in halves) and FLIP, separately for few samples and many. The command may be stopped:
existing runs are continued or read. --only selects variants.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bench.common import metadata, save
from ngpt.errors import NgptError
from ngpt.measure.metrics import scores
from ngpt.network.model import Reconstructor, parameters
from ngpt.network.run_torch import layers_of
from ngpt.network.safetensors import load_weights
from ngpt.repair import repair
from ngpt.system import configs
from ngpt.system.writing import markdown_table
from ngpt.training.cost import network_of, per_pixel
from ngpt.training.crops import open_crops
from ngpt.training.examples import judges_of
from ngpt.training.images import Images
from ngpt.training.loss import make_loss
from ngpt.training.settings import Settings, read_settings
from ngpt.training.split import split
from ngpt.training.trainer import Trainer

# Changes to the configuration; the plain network has about the same number of parameters.
VARIANTS: dict[str, list[str]] = {
    "dense": [],
    "no gradients": ['model.inputs=["primal", "albedo", "normal", "depth"]'],
    "l1 alone": ['loss.kind="l1"', "loss.l1=1.0", "loss.gradient=0.0"],
    "plain": ['model.network="plain"', "model.channels=[13, 26, 39, 53]", "model.units=[]"],
    "average pooling": ['model.pooling="average"'],
    "maximum pooling": ['model.pooling="maximum"'],
    "bilinear": ['model.pooling="bilinear"'],
}
METRICS = ("relMSE trimmed", "FLIP")
FEW = 16  # below this number of samples, an input counts as "few"


def train(settings: Settings, crops: Sequence[Any], held_out: Sequence[Any], out: Path) -> None:
    """Trains to the last step of the run in ``out``, or continues it."""
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(settings, Images(settings, crops, held_out, make_loss(settings.loss)), out)
    if trainer.checkpoint.exists():
        trainer.resume()
    if trainer.step < settings.run.steps and not trainer.run():
        raise NgptError(f"{out}: stopped at step {trainer.step}; the same command goes on")


@torch.no_grad()
def judged(model: Reconstructor, crops: Sequence[Any]) -> list[dict[str, float]]:
    """A row for each input of each crop: samples per pixel, metrics of the network's image and of the primal."""
    found = []
    for crop in crops:
        halves = judges_of(crop, model.config)
        for k in range(crop.inputs):
            stack = repair(crop.stack(k), model.config.reads_gradients)
            layers = {name: layer[None] for name, layer in layers_of(stack, model.config).items()}
            image = model(layers)[0].permute(1, 2, 0).numpy()
            given = layers["primal"][0].permute(1, 2, 0).numpy()
            row = {f"{name} primal": value for name, value in scores(METRICS, given, *halves).items()}
            found.append({"spp": crop.spp[k], **scores(METRICS, image, *halves), **row})
    return found


def mean(rows: Sequence[dict[str, float]], name: str, few: bool) -> float:
    """The geometric mean over inputs of few samples, or of many; NaN of none."""
    # The noise of two halves may outweigh a very small error and make it negative.
    values = [max(row[name], 1e-9) for row in rows if (row["spp"] < FEW) == few]
    return math.exp(math.fsum(map(math.log, values)) / len(values)) if values else math.nan


def table(result: dict[str, Any]) -> str:
    """Markdown: a row for each variant, and one for the input."""
    heads = [f"{name}, {which}" for name in METRICS for which in (f"below {FEW} spp", f"from {FEW} spp")]

    def cells(rows: Sequence[dict[str, float]], end: str = "") -> list[str]:
        return [f"{mean(rows, name + end, few):.4f}" for name in METRICS for few in (True, False)]

    rows = [
        [name, *(f"{found[cost] / 1e3:.0f} k" for cost in ("parameters", "multiplications")), *cells(found["inputs"])]
        for name, found in result["variants"].items()
    ]
    first = next(iter(result["variants"].values()))
    rows.append(["the input", "", "", *cells(first["inputs"], " primal")])
    return "\n".join(markdown_table(["variant", "parameters", "multiplications per pixel", *heads], rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, nargs="+", metavar="SET", help="training sets")
    parser.add_argument("--apart", required=True, nargs="+", metavar="SCENE", help="beginnings of scenes' names")
    parser.add_argument("--out", required=True, type=Path, help="folder of the runs")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="NAME", help="variants")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting of all")
    parser.add_argument("-o", "--output", default="bench/results/ablations.json", metavar="JSON")
    args = parser.parse_args()

    shared = [f"data.folders={_toml(args.data)}", f"data.validation={_toml(args.apart)}", *args.set]
    crops, held_out, _ = split([crop for folder in args.data for crop in open_crops(folder)], tuple(args.apart))
    if not crops or not held_out:
        raise NgptError(f"{len(crops)} crops to train on, {len(held_out)} kept apart: change --apart")
    config, variants = configs.find_config("ablations", configs.TRAINING), {}
    for name in args.only:
        settings = read_settings(config, [*shared, *VARIANTS[name]])
        out = args.out / name.replace(" ", "-")
        train(settings, crops, held_out, out)
        model, _ = load_weights(out / "weights.safetensors")
        variants[name] = {
            "parameters": parameters(model),
            "multiplications": per_pixel(*network_of(settings))[0],
            "steps": settings.run.steps,
            "inputs": judged(model, held_out),
        }
        print(f"{name}: measured", flush=True)
    result = {
        "metadata": metadata("torch"),
        "crops": len(crops),
        "crops apart": len(held_out),
        "scenes apart": sorted({crop.scene for crop in held_out}),
        "variants": variants,
    }
    save(args.output, result)
    print(table(result))


def _toml(names: Sequence[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


if __name__ == "__main__":
    main()
