"""Trains a reconstruction: python train.py --config configs/NAME.toml --out DIR

Run the same command again to continue a run that was stopped. Several GPUs: torchrun --nproc-per-node N train.py ...
"""

import argparse
import json
import sys
from pathlib import Path

from ngpt.errors import NgptError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True, help="settings, a TOML file: configs/*.toml")
    parser.add_argument("--out", help="folder of the run: checkpoint, weights, log; made if it is not there")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting, for example run.steps=1000"
    )
    parser.add_argument("--dry-run", action="store_true", help="print size and cost of the network, and do not train")
    options = parser.parse_args(arguments)
    try:
        return run(options)
    except NgptError as error:
        print(f"train.py: error: {error}", file=sys.stderr)
        return 1


def run(options: argparse.Namespace) -> int:
    # Here and not above: a mistyped option is said at once, not after the seconds that torch takes to come in.
    from ngpt.network.cost import cost
    from ngpt.network.data import open_crops, split
    from ngpt.network.distributed import Processes
    from ngpt.network.losses import make_loss
    from ngpt.network.settings import read_settings
    from ngpt.network.trainer import Trainer

    settings = read_settings(options.config, options.set)
    if options.dry_run:
        print(cost(settings))
        return 0
    if not options.out:
        raise NgptError("--out is missing: the folder for checkpoint, weights and log")
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    crops = [crop for folder in settings.data.folders for crop in open_crops(folder)]
    training, held_out = split(crops, settings.data.validation)
    processes = Processes()
    trainer = Trainer(settings, training, held_out, make_loss(settings.loss), out, processes)
    if trainer.checkpoint.exists():
        trainer.resume()
        print(f"continuing {out} at step {trainer.step} of {settings.run.steps}")
    (out / "settings.json").write_text(json.dumps(settings.to_dict(), indent=2) + "\n")
    finished = trainer.run()
    processes.close()
    print(f"{'finished' if finished else 'stopped'} at step {trainer.step}: {out / 'weights.safetensors'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
