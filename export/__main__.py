"""``python -m export --method l2 -o l2.onnx``: writes a reconstruction as an ONNX file."""

import argparse
import sys
from pathlib import Path

from ngpt.console import Console
from ngpt.errors import NgptError
from ngpt.files import atomic_output
from ngpt.poisson import DEFAULT_ALPHA


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m export", description="Write a reconstruction as an ONNX file.")
    parser.add_argument("--method", choices=["l2"], default="l2", help="l2: least-squares screened Poisson")
    parser.add_argument("--alpha", type=float, default=DEFAULT_ALPHA, help=f"default: {DEFAULT_ALPHA}")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.onnx")
    parser.add_argument("--force", action="store_true", help="overwrite a file that exists")
    args = parser.parse_args(arguments)
    console = Console()
    try:
        try:
            from export.poisson import l2_model
        except ModuleNotFoundError as error:
            raise NgptError(f"export needs the package '{error.name}'; `pip install 'ngpt-recon[export]'`") from error
        with atomic_output(args.output, args.force) as temporary:
            temporary.write_bytes(l2_model(args.alpha).SerializeToString())
    except NgptError as error:
        console.error(error)
        return 2
    console.say(f"{args.output}: {args.method}, alpha {args.alpha}, {args.output.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
