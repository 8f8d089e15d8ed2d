"""``ngpt export``: writes a reconstruction as an ONNX file, a network for OIDN's runtime, or weights in 16 bits."""

import argparse
from pathlib import Path

from ngpt.classical.poisson import DEFAULT_ALPHA
from ngpt.cli.arguments import add_force, output_file
from ngpt.errors import NgptError, WrongUse
from ngpt.system.console import Console
from ngpt.system.writing import write_bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--weights",
        type=Path,
        nargs="+",
        metavar="FILE.safetensors",
        help="network that `ngpt train` made; several files are averaged into a .safetensors file",
    )
    source.add_argument("--method", choices=["l2"], help="a method, not a network: l2 (default), screened Poisson")
    parser.add_argument(
        "--alpha", type=float, default=DEFAULT_ALPHA, help=f"weight of the noisy image in l2 (default: {DEFAULT_ALPHA})"
    )
    parser.add_argument(
        "--precision",
        choices=["float32", "float16"],
        default="float32",
        help="precision of the network; its output is always float32",
    )
    parser.add_argument("--vector", type=Path, metavar="FOLDER", help="also write an example of input and output here")
    what = (
        "model to write: .onnx, and for a network beside it .statistics.onnx, which hosts need for tiles; "
        ".tza for OIDN; or .safetensors: weights in 16 bits"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=what)
    add_force(parser)


def run(args: argparse.Namespace, console: Console) -> int:
    if not args.weights and args.vector:
        raise WrongUse("--vector belongs to networks; leave it out for a classical method")
    if args.output.suffix in (".tza", ".safetensors") and (not args.weights or args.vector):
        raise WrongUse(f"{args.output}: {args.output.suffix} files hold only networks; give --weights, and no --vector")
    if args.weights and len(args.weights) > 1 and args.output.suffix != ".safetensors":
        raise WrongUse(f"{args.output}: the mean of several files is written to a .safetensors file; export that one")
    output_file(args.output, args)
    for path in write(args):
        console.say(f"{path}: {path.stat().st_size} bytes")
    return 0


def write(args: argparse.Namespace) -> list[Path]:
    """Writes the requested files and returns their paths."""
    if args.output.suffix == ".tza":
        from ngpt.export.weights import oidn_weights

        write_bytes(args.output, oidn_weights(args.weights[0]), args.force)
        return [args.output]
    if args.output.suffix == ".safetensors":
        from ngpt.export.weights import write_halves

        write_halves(args.weights, args.output, args.force)
        return [args.output]
    if not args.weights:
        from ngpt.export.poisson import l2_model

        models = {args.output: l2_model(args.alpha)}
    else:
        from ngpt.export.network import network_model, statistics_model
        from ngpt.export.temporal import temporal_model
        from ngpt.network.safetensors import read_tensors

        weights = args.weights[0]
        if read_tensors(weights)[1].get("kind") == "temporal":
            if args.vector:
                raise NgptError(f"{weights}: a network that blends frames has no example to write; leave --vector out")
            write_bytes(args.output, temporal_model(weights).SerializeToString(), args.force)
            return [args.output]
        name, beside = weights.stem, output_file(args.output.with_suffix(".statistics.onnx"), args)
        models = {args.output: network_model(weights, name, args.precision)}
        models[beside] = statistics_model(weights, name)
    for path, model in models.items():
        write_bytes(path, model.SerializeToString(), args.force)
    if args.vector:
        from ngpt.export.vector import write_vector

        write_vector(models[args.output], args.vector, args.force)
    return list(models)
