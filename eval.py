"""Every method on the same scenes with the same clock: what ``ngpt evaluate`` does."""

import sys

from ngpt.cli import door


def main(arguments: list[str] | None = None) -> int:
    return door("evaluate", "python eval.py", arguments)


if __name__ == "__main__":
    sys.exit(main())
