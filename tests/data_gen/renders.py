"""Mitsuba and Dr.Jit, for modules of tests that need them from their first line: where there are none they skip."""

import pytest

dr, mi = (pytest.importorskip(name) for name in ("drjit", "mitsuba"))
