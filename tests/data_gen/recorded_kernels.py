"""Fixtures about the kernels that renders record, for tests of samplers of ours and of studies."""

import gc
import logging
from collections import Counter
from functools import wraps

import pytest


class Recordings:
    """How often each function that ``Frozen`` calls has run as Python, by its name: once for each recording of it."""

    def __init__(self):
        self.of = Counter()

    def total(self) -> int:
        return sum(self.of.values())


@pytest.fixture
def recordings(renderer, monkeypatch):
    from data_gen.paths.frozen import Frozen

    # A scene of an earlier test that goes between two passes would be a reason to record anew.
    gc.collect()
    seen, wrapped, real = Recordings(), {}, Frozen.__call__

    def call(self, f, *args, **options):
        @wraps(getattr(f, "func", f))
        def counted(*args):
            seen.of[getattr(getattr(f, "func", f), "__name__", "")] += 1
            return f(*args)

        return real(self, wrapped.setdefault((id(self), f), counted), *args, **options)

    monkeypatch.setattr(Frozen, "__call__", call)
    return seen


@pytest.fixture(autouse=True)
def kernels_are_recorded_once(request):
    """A sampler that is recorded anew in each pass costs a second of each. Only tests marked ``recorded_anew`` may."""
    lines: list[str] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())

    # By name: most tests here import no renderer.
    log, handler = logging.getLogger("ngpt.data_gen.paths.frozen"), Kept()
    log.addHandler(handler)
    yield
    log.removeHandler(handler)
    if lines and "recorded_anew" not in request.keywords:
        pytest.fail("; ".join(lines))
