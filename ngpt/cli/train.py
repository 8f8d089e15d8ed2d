"""``ngpt train``: trains a network, or continues a run."""

import argparse
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ngpt.cli.arguments import add_config, config_of, write_template
from ngpt.errors import NgptError, WrongUse
from ngpt.system import configs
from ngpt.system.console import Console
from ngpt.system.files import exclusive, make_folder
from ngpt.system.writing import write_text
from ngpt.training.run_summary import SETTINGS, WEIGHTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "The same command continues a run that was stopped. Several GPUs: "
        "torchrun --nproc-per-node N train.py ..., or torchrun --nproc-per-node N -m ngpt train ..."
    )
    add_config(parser, configs.TRAINING, "settings")
    parser.add_argument("--out", help="folder of the run: checkpoint, weights, log")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting, such as run.steps=1000"
    )
    parser.add_argument("--dry-run", action="store_true", help="only print size and cost of the network")


def run(args: argparse.Namespace, console: Console) -> int:
    config = config_of(args, configs.TRAINING)
    # Imported here, so that a mistyped option is reported at once, and not after the seconds of importing torch.
    from ngpt.training.cost import cost
    from ngpt.training.crops import open_crops
    from ngpt.training.distributed import Processes
    from ngpt.training.run_record import write_record
    from ngpt.training.run_summary import PAGE
    from ngpt.training.settings import read_settings
    from ngpt.training.trainer import Trainer, show

    settings = read_settings(config, args.set)
    if args.init:
        if args.set:
            raise NgptError("--init and --set cannot be combined; change settings in the file that --init writes")
        from ngpt.training.parameters import training_template

        return write_template(args, training_template(config.read_text(encoding="utf-8")), "train", console)
    if args.dry_run:
        print(cost(settings))
        return 0
    if not args.out:
        raise WrongUse("--out is missing: the folder for checkpoint, weights and log")
    for folder in _on_disk(settings):
        open_crops(folder)  # so that its errors are raised before any file is made
    out = make_folder(args.out)
    say = (lambda text: None) if console.quiet else show
    processes = Processes()
    with ExitStack() as stack:
        if processes.rank == 0:
            stack.enter_context(exclusive(out))
        trainer = Trainer(settings, _task(settings, out, stack, processes, say), out, processes, say=say)
        if trainer.checkpoint.exists():
            trainer.resume()
            if trainer.step >= settings.run.steps:
                say(f"{out} has all its {settings.run.steps} steps; --set run.steps=N goes on with it")
            else:
                say(f"continuing {out} at step {trainer.step} of {settings.run.steps}")
        if processes.rank == 0:
            write_text(out / SETTINGS, json.dumps(settings.to_dict(), indent=2) + "\n")
            write_record(out, settings, config, trainer.model, trainer.device)
        # With several processes, one reports for all.
        listener = console if processes.rank == 0 else Console(quiet=True)
        with listener.progress("train", "steps", rate=True) as progress:
            finished = trainer.run(progress)
    processes.close()
    say(f"{'finished' if finished else 'stopped'} at step {trainer.step}: {out / WEIGHTS}")
    if processes.rank == 0:
        say(f"{out / PAGE}: open it in a browser")
    return 0 if finished or not trainer.signal else 128 + trainer.signal


def _on_disk(settings: Any) -> list[str]:
    """The folders of training sets that exist on disk; others are rendered during the training."""
    return [folder for folder in settings.data.folders if not folder.endswith(".toml")]


def _task(settings: Any, out: Path, stack: ExitStack, processes: Any, say: Callable[[str], None]) -> Any:
    """The task of the settings with its data. When ``stack`` is closed, the rendering of training sets ends."""
    from ngpt.system.parts import find_crops
    from ngpt.training.clips import clips
    from ngpt.training.crops import JoinedCrops, open_crops
    from ngpt.training.images import Images
    from ngpt.training.loss import make_loss
    from ngpt.training.split import split
    from ngpt.training.temporal import Blending

    loss = make_loss(settings.loss)
    on_disk = _on_disk(settings)
    if settings.temporal:
        if processes.rank == 0:
            methods = ", ".join(settings.temporal.methods)
            say(f"results frame by frame, by {methods}: those not yet in {out / 'results'} are made now")
        found = list(clips(on_disk, settings.temporal.methods, out / "results"))
    else:
        found = [crop for folder in on_disk for crop in open_crops(folder)]
    training, held_out, message = split(found, settings.data.validation, settings.data.validation_share)
    if message and processes.rank == 0:
        say(message)
    if settings.temporal:
        return Blending(settings, training, held_out)
    made = [configs.find_config(f, configs.DATASET) for f in settings.data.folders if f.endswith(".toml")]
    streams = [stack.enter_context(find_crops()(config, settings.data.kept)) for config in made]
    return Images(settings, JoinedCrops(training, *streams), held_out, loss)
