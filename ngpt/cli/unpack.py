"""``ngpt unpack``: a stack as raw files, for programs that read no OpenEXR."""

import argparse
from pathlib import Path

from ngpt.cli.arguments import add_force, add_layers, add_untrusted
from ngpt.cli.denoise import FILES
from ngpt.io.exr import read
from ngpt.io.rawlayers import planes, write_layers
from ngpt.system.console import Console


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stack", metavar="STACK", help=".exr file, of any renderer")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder for NAME.f32 and layers.json")
    for layer in FILES:
        parser.add_argument(f"--{layer}", metavar="FILE", help=f"{layer}, from a file of its own")
    add_layers(parser)
    add_untrusted(parser)
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    files = {layer: file for layer in FILES if (file := getattr(args, layer))}
    stack = read(args.stack, dict(args.layer), args.untrusted, files)
    write_layers(args.folder, planes(stack), args.force)
    console.say(f"{args.stack} -> {args.folder}: {stack.width}x{stack.height}, {', '.join(stack.names)}")
    return 0
