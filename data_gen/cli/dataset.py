"""``ngpt dataset``: makes a training set, or continues one."""

import argparse
from pathlib import Path

from ngpt.cli.arguments import add_config, part
from ngpt.system import configs
from ngpt.system.console import Console


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Run the same command again to continue a training set that was stopped."
    add_config(parser, configs.DATASET, "what to render")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the training set")
    parser.add_argument("--shard", type=part, default=(0, 1), metavar="i/n", help="make only this part, for job arrays")
    parser.add_argument(
        "--workers", type=int, default=1, help="processes (default: 1, which uses all cores by threads)"
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")


def run(args: argparse.Namespace, console: Console) -> int:
    path = configs.find_config(args.config, configs.DATASET)
    # Only the verbs that render import the renderer.
    from data_gen.dataset.card import write_card
    from data_gen.dataset.config import read_config
    from data_gen.dataset.jobs import cluster, generate, processes

    config = read_config(path)
    executor = cluster(args.cluster) if args.cluster else processes(args.workers)
    with executor as workers, console.progress(str(args.out), "crops") as progress:
        generate(config, args.out, workers, shard=args.shard, variant=args.variant, progress=progress)
    write_card(args.out)
    return 0
