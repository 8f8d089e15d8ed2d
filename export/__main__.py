"""``python -m export``: writes a reconstruction as an ONNX file, as ``ngpt export`` does."""

import sys

from ngpt.cli import door


def main(arguments: list[str] | None = None) -> int:
    return door("export", "python -m export", arguments)


if __name__ == "__main__":
    sys.exit(main())
