"""``ngpt merge``: merges gradient stacks into one that has the samples and the pixels of all."""

import argparse

from ngpt.cli.arguments import add_force, add_json, output_file, print_json
from ngpt.io.exr import read, write
from ngpt.merging import UNFINISHED, merge
from ngpt.system.console import Console
from ngpt.system.files import save


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "stacks", nargs="+", metavar="STACK", help="stacks of one image: with different seeds, or tiles"
    )
    parser.add_argument("-o", "--output", metavar="FILE", required=True, help="stack to write")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    target = output_file(args.output, args)
    stacks = [read(path) for path in args.stacks]
    merged = merge(stacks)
    for stack in stacks:
        if UNFINISHED in stack.attributes:
            done = f"was {stack.attributes[UNFINISHED]} at {stack.attributes['ngpt:spp']} samples per pixel"
            console.say(f"{stack.path}: {done}; the same `ngpt render` with --skip-existing continues it")
    save(target, lambda path, overwrite: write(path, merged, overwrite=overwrite), args.force)
    spp, seed = merged.attributes["ngpt:spp"], merged.attributes["ngpt:seed"]
    console.say(f"{len(args.stacks)} stacks -> {target}: {merged.place}, {spp} spp, seeds {seed}")
    if args.json:
        print_json({"output": str(target), "inputs": args.stacks, "spp": spp, "seed": seed, "layers": merged.names})
    return 0
