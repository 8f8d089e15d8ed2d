"""``python -m data_gen``: makes a training set, or continues one."""

import argparse
import re
import sys
from pathlib import Path

from ngpt.system.console import Console, run_command


def part(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or int(match[1]) >= int(match[2]):
        raise argparse.ArgumentTypeError(f"'{text}' is not i/n with 0 <= i < n, such as 0/4")
    return int(match[1]), int(match[2])


def main() -> int:
    return run_command(run, interrupted="interrupted; run the same command to continue")


def run() -> int:
    parser = argparse.ArgumentParser(prog="python -m data_gen", description="Makes a training set, or continues one.")
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="such as configs/data-cpu.toml")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the training set")
    parser.add_argument("--shard", type=part, default=(0, 1), metavar="i/n", help="make only this part, for job arrays")
    parser.add_argument(
        "--workers", type=int, default=1, help="processes (default: 1, which uses all cores by threads)"
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)")
    args = parser.parse_args()
    from data_gen.dataset.card import write_card
    from data_gen.dataset.config import read_config
    from data_gen.dataset.jobs import cluster, generate, processes

    config = read_config(args.config)
    executor = cluster(args.cluster) if args.cluster else processes(args.workers)
    with executor as workers, Console().progress(str(args.out), "crops") as progress:
        generate(config, args.out, workers, shard=args.shard, variant=args.variant, progress=progress)
    write_card(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
