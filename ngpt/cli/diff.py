"""``ngpt diff``: prints all metrics between two images. The exit status says whether they agree."""

import argparse
from collections.abc import Sequence

from ngpt.cli.arguments import add_json, print_json, tell_lacks
from ngpt.cli.streams import standard_input
from ngpt.io.exr import read_picture
from ngpt.measure.metrics import compare
from ngpt.measure.shown import available, judge
from ngpt.system.console import Console
from ngpt.windows import overlap


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Images are compared in the pixels that both have, according to their data windows."
    parser.add_argument("image", metavar="A", help="image to compare: its root R G B, in a result file the result")
    parser.add_argument("reference", metavar="B", help="image to compare it with")
    parser.add_argument(
        "--tolerance", type=float, default=1e-6, metavar="RELMSE", help="images agree up to this relMSE (1e-6)"
    )
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    with standard_input([args.image, args.reference]) as names:
        return compare_files(names, args, console)


def compare_files(names: Sequence[str], args: argparse.Namespace, console: Console) -> int:
    images, places = zip(*map(read_picture, names), strict=True)
    both = overlap(names, places)
    image, reference = both.of(images)
    if both.line:
        console.say(both.line)
    usable, lacks = available(*image.shape[:2])
    metrics = compare(image, reference)
    metrics |= judge([name for name in usable if name not in metrics], image, reference)[0]
    agree = metrics["relMSE"] <= args.tolerance and metrics["nonfinite"] == 0
    if args.json:
        print_json({"agree": agree, "tolerance": args.tolerance, "metrics": metrics})
    else:
        for name, value in metrics.items():
            print(f"{name:16} {value:.6g}")
        print(f"{'agree' if agree else 'differ':16} (relMSE up to {args.tolerance:g}, no non-finite pixels)")
    tell_lacks(lacks, console)
    return 0 if agree else 1
