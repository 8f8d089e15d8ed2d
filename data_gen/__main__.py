"""``python -m data_gen``: makes a training set, as ``ngpt dataset`` does."""

import sys

from ngpt.cli import door


def main(arguments: list[str] | None = None) -> int:
    return door("dataset", "python -m data_gen", arguments)


if __name__ == "__main__":
    sys.exit(main())
