"""Trains a reconstruction: python train.py --config configs/NAME.toml --out DIR

Run the same command again to continue a run that was stopped. Several GPUs: torchrun --nproc-per-node N train.py ...
"""

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.console import run_command
from ngpt.system.files import atomic_output, exclusive


def main(arguments: list[str] | None = None) -> int:
    return run_command(lambda: run(arguments), "train.py", "interrupted; run the same command to continue")


def run(arguments: list[str] | None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True, help="settings, a TOML file: configs/*.toml")
    parser.add_argument("--out", help="folder of the run: checkpoint, weights, log; made if it is not there")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting, for example run.steps=1000"
    )
    parser.add_argument("--dry-run", action="store_true", help="print size and cost of the network, and do not train")
    options = parser.parse_args(arguments)
    # Here and not above: a mistyped option is said at once, not after the seconds that torch takes to come in.
    from ngpt.training.cost import cost
    from ngpt.training.distributed import Processes
    from ngpt.training.examples import Mixture, open_crops, split
    from ngpt.training.loss import make_loss
    from ngpt.training.settings import read_settings
    from ngpt.training.trainer import Trainer, show

    settings = read_settings(options.config, options.set)
    if options.dry_run:
        print(cost(settings))
        return 0
    if not options.out:
        raise NgptError("--out is missing: the folder for checkpoint, weights and log")
    out = Path(options.out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NgptError(f"{out}: cannot be made: {error.strerror}; name another folder with --out") from error
    loss = make_loss(settings.loss)
    processes = Processes()
    with ExitStack() as stack:
        if processes.rank == 0:
            stack.enter_context(exclusive(out))
        on_disk = [folder for folder in settings.data.folders if not folder.endswith(".toml")]
        crops, held_out = split([crop for f in on_disk for crop in open_crops(f)], settings.data.validation)
        streams = [stack.enter_context(stream(f)) for f in settings.data.folders if f.endswith(".toml")]
        training = Mixture(crops, *streams)
        # What is read from a stream is replaced: it must not be kept.
        trainer = Trainer(settings, training, held_out, loss, out, processes, cache=not streams)
        if trainer.checkpoint.exists():
            trainer.resume()
            show(f"continuing {out} at step {trainer.step} of {settings.run.steps}")
        if processes.rank == 0:
            with atomic_output(out / "settings.json", overwrite=True) as temporary:
                temporary.write_text(json.dumps(settings.to_dict(), indent=2) + "\n")
        finished = trainer.run()
    processes.close()
    show(f"{'finished' if finished else 'stopped'} at step {trainer.step}: {out / 'weights.safetensors'}")
    return 0 if finished or not trainer.signal else 128 + trainer.signal


def stream(config: str):
    """Crops of that dataset configuration, rendered in another process while they are trained on."""
    from data_gen.dataset.config import read_config
    from data_gen.dataset.jobs import processes
    from data_gen.dataset.stream import Stream

    return Stream(read_config(Path(config)), processes(1))


if __name__ == "__main__":
    sys.exit(main())
