"""``python -m data_gen``: makes a training set, as ``ngpt dataset`` does."""

import sys

from data_gen.cli import VERBS
from ngpt.cli import door


def main(arguments: list[str] | None = None) -> int:
    return door("dataset", "python -m data_gen", arguments, verbs=VERBS)


if __name__ == "__main__":
    sys.exit(main())
