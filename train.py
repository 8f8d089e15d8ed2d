"""Trains a network, as ``ngpt train`` does. For several GPUs: torchrun --nproc-per-node N train.py ..."""

import sys

from ngpt.cli import door


def main(arguments: list[str] | None = None) -> int:
    return door("train", "python train.py", arguments, name="train.py")


if __name__ == "__main__":
    sys.exit(main())
