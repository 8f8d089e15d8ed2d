"""``ngpt unpack``: writes a stack as raw files, for programs that cannot read OpenEXR."""

import argparse
from pathlib import Path

from ngpt.cli.arguments import add_files, add_force, add_layers, add_untrusted, add_view, given_files
from ngpt.cli.streams import standard_input
from ngpt.io.exr import read
from ngpt.io.rawlayers import planes, write_layers
from ngpt.system.console import Console


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stack", metavar="STACK", help="image of any renderer; -: standard input")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder to write NAME.f32 and layers.json to")
    add_files(parser)
    add_layers(parser)
    add_view(parser, "default: the first")
    add_untrusted(parser)
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    with standard_input([args.stack]) as (source,):
        stack = read(source, dict(args.layer), args.untrusted, given_files(args), args.view)
        write_layers(args.folder, planes(stack), args.force)
        console.say(f"{source} -> {args.folder}: {stack.width}x{stack.height}, {', '.join(stack.names)}")
    return 0
