"""``ngpt dataset``: makes a training set, or continues one."""

import argparse
from pathlib import Path

from data_gen.cli import KERNELS
from ngpt.cli.arguments import add_config, config_of, part, write_template
from ngpt.errors import WrongUse
from ngpt.system import configs
from ngpt.system.console import Console
from ngpt.system.files import exclusive
from ngpt.training.dataset import Dataset


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "The same command continues a training set that was stopped."
    add_config(parser, configs.DATASET, "what to render")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the training set")
    parser.add_argument("--shard", type=part, default=(0, 1), metavar="i/n", help="make only this part, for job arrays")
    parser.add_argument(
        "--workers", type=int, default=1, help="number of processes (default: 1, with a thread for each core)"
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")
    parser.add_argument(
        "--layout",
        choices=("oidn",),
        help="also write the finished set as images to DIR/oidn/train and DIR/oidn/valid, for the "
        "training of Open Image Denoise",
    )
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")


def run(args: argparse.Namespace, console: Console) -> int:
    path = config_of(args, configs.DATASET)
    if args.init:
        from data_gen.dataset.config import DatasetConfig
        from ngpt.system.templates import template

        return write_template(args, template(path.read_text(encoding="utf-8"), {"": DatasetConfig}), "dataset", console)
    if not args.out:
        raise WrongUse("--out is missing: the folder of the training set")
    # Only the verbs that render import the renderer.
    from data_gen.backend import use_variant
    from data_gen.cluster import cluster
    from data_gen.dataset.card import write_card
    from data_gen.dataset.config import read_config
    from data_gen.dataset.jobs import generate, processes

    config = read_config(path)
    if not args.cluster:
        use_variant(args.variant)  # fails here if the variant cannot be used, before any file is made
    executor = cluster(args.cluster) if args.cluster else processes(args.workers)
    with executor as workers, console.progress(str(args.out), "crops", begins=KERNELS) as progress:
        generate(config, args.out, workers, shard=args.shard, variant=args.variant, progress=progress)
    write_card(args.out)
    if args.layout:
        write_oidn(args.out, console)
    return 0


def write_oidn(out: Path, console: Console) -> None:
    """Writes the set as images too, once it is complete. If it is made in several parts, the last part to end does
    this.
    """
    from data_gen.dataset.oidn import write_layout

    data, target = Dataset(out), out / "oidn"
    made = sum(len(entry["crops"]) + len(entry["failures"]) for entry in data.manifest["shards"])
    if made < data.manifest["planned"]:
        console.say(f"{target}: is written when all crops are made; {made} of {data.manifest['planned']} are")
        return
    with exclusive(out, wait=True), console.progress(str(target), "crops") as progress:
        left_out = write_layout(data, target, progress)
    if left_out:
        console.say(f"{target}: without {left_out} inputs that have as many samples as another of their crop")
    console.say(f"{target}: python preprocess.py hdr alb nrm --filter RT -D {target.resolve()} -t train -v valid")
