"""``python -m export --weights W.safetensors -o model.onnx``: writes a reconstruction as an ONNX file."""

import argparse
import sys
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.console import Console, run_command
from ngpt.system.files import atomic_output, check_output


def main(arguments: list[str] | None = None) -> int:
    return run_command(lambda: run(arguments))


def run(arguments: list[str] | None) -> int:
    from ngpt.classical.poisson import DEFAULT_ALPHA

    parser = argparse.ArgumentParser(prog="python -m export", description="Write a reconstruction as an ONNX file.")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--weights", type=Path, metavar="FILE.safetensors", help="a network, as train.py makes them")
    what.add_argument("--method", choices=["l2"], help="l2, the default: least-squares screened Poisson")
    parser.add_argument("--alpha", type=float, default=DEFAULT_ALPHA, help=f"of l2; default: {DEFAULT_ALPHA}")
    parser.add_argument("--precision", choices=["float32", "float16"], default="float32", help="of a network's body")
    parser.add_argument("--statistics", type=Path, metavar="FILE.onnx", help="also write the graph that tiling needs")
    parser.add_argument("--vector", type=Path, metavar="FOLDER", help="also write an example of inputs and output")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.onnx")
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")
    args = parser.parse_args(arguments)
    for path in (args.output, args.statistics):
        if path is not None:
            check_output(path, args.force)
    if not args.weights and (args.statistics or args.vector):
        raise NgptError("--statistics and --vector belong to networks; leave them out for a classical method")
    try:
        written = write(args)
    except ModuleNotFoundError as error:
        raise NgptError(f"export needs the package '{error.name}'; `pip install 'ngpt-recon[export]'`") from error
    for path in written:
        Console().say(f"{path}: {path.stat().st_size} bytes")
    return 0


def write(args: argparse.Namespace) -> list[Path]:
    """Writes what the arguments ask for; returns the files."""
    if not args.weights:
        from ngpt.export.poisson import l2_model

        models = {args.output: l2_model(args.alpha)}
    else:
        from ngpt.export.network import network_model, statistics_model

        name = args.weights.stem
        models = {args.output: network_model(args.weights, name, args.precision)}
        if args.statistics:
            models[args.statistics] = statistics_model(args.weights, name)
    for path, model in models.items():
        with atomic_output(path, args.force) as temporary:
            temporary.write_bytes(model.SerializeToString())
    if args.vector:
        from ngpt.export.vector import write_vector

        write_vector(models[args.output], args.vector, args.force)
    return list(models)


if __name__ == "__main__":
    sys.exit(main())
