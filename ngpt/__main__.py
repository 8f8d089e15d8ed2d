"""``python -m ngpt``, and the command ``ngpt``."""

import sys


def main() -> int:
    """Runs the command line. Ctrl-C prints one line too if the command is still being imported."""
    try:
        from ngpt.cli import main as run
    except KeyboardInterrupt:
        print("ngpt: error: interrupted", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
