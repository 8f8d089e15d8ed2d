"""``python -m ngpt``."""

import sys

from ngpt.cli import main

sys.exit(main())
