"""Laws run where their code is not that with which they passed on this machine last; with ``NGPT_STRICT=1`` all run.

The code of a law is every file of this repository that its module or its sampler imports, and what those import,
without comments and docstrings; the stored references; and the versions of what renders. The hash of each law is kept
outside of the checkout, in $XDG_CACHE_HOME/ngpt-laws or ~/.cache/ngpt-laws.
"""

import hashlib
import os
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

import pytest
from references import STORE

from data_gen.samplers import SAMPLERS
from ngpt.system.source import code_text, imports

ROOT = Path(__file__).parents[3]
# Where modules of the repository are, as tests import them
PLACES = (ROOT, ROOT / "studies", ROOT / "tests", ROOT / "tests" / "data_gen", Path(__file__).parent)
PASSED = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ngpt-laws"
PACKAGES = ("drjit", "mitsuba", "numpy", "scipy")
# Laws reconstruct nothing.
NOT_FOLLOWED = {ROOT / "ngpt" / "methods.py"}


def pytest_runtest_setup(item):
    record = _record(item)
    if os.environ.get("NGPT_STRICT") != "1" and record.exists() and record.read_text() == code_of(item):
        pytest.skip("it has passed with this code: NGPT_STRICT=1 runs it")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "call" and report.passed:
        record = _record(item)
        record.parent.mkdir(parents=True, exist_ok=True)
        # As a whole or not at all: other processes write beside.
        unfinished = record.with_suffix(f".{os.getpid()}")
        unfinished.write_text(code_of(item))
        unfinished.replace(record)
    return report


def _record(item) -> Path:
    return PASSED / hashlib.sha256(item.nodeid.encode()).hexdigest()[:32]


def code_of(item) -> str:
    """SHA-256 of all that a law depends on; of the code of every sampler where its parameters name none."""
    parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
    named = {str(getattr(value, "sampler", value)) for value in parameters} & SAMPLERS.keys()
    return hash_of(item.path, frozenset(named or SAMPLERS))


@cache
def hash_of(path: Path, samplers: frozenset[str]) -> str:
    digest = hashlib.sha256(STORE.read_bytes())
    digest.update("\n".join([sys.version, *map(version, PACKAGES)]).encode())
    for file in sorted(files_of(path, samplers)):
        digest.update(f"{file.relative_to(ROOT)}\n{_text(file)}\n".encode())
    return digest.hexdigest()


_text = cache(code_text)


def files_of(path: Path, samplers: frozenset[str]) -> set[Path]:
    """What a module of tests and samplers import, and what that imports."""
    queue = [path, *(file for name in samplers for file in _files_of(SAMPLERS[name].module))]
    found: set[Path] = set()
    while queue:
        file = queue.pop()
        if file not in found:
            found.add(file)
            queue += () if file in NOT_FOLLOWED else imported(file)
    return found


@cache
def imported(file: Path) -> frozenset[Path]:
    """Files of the repository that a file imports anywhere in it."""
    return frozenset(file for name in imports(file) for file in _files_of(name))


def _files_of(module: str) -> set[Path]:
    """The file of a module, and those of the packages that it is in; none where the repository has no such module."""
    words, found = module.split("."), set()
    for place in PLACES:
        for count in range(1, len(words) + 1):
            path = place.joinpath(*words[:count])
            found |= {file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()}
    return found
