"""Python with renderers in it: the one that NGPT_RENDERERS names, or that of the folder ``.renderers`` beside this
project's files.

    python3.11 -m venv .renderers
    .renderers/bin/pip install "bpy==5.0.*" pyluxcore
"""

import os
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent


@lru_cache
def _has(python: str, module: str) -> bool:
    code = f"from importlib.util import find_spec; print(find_spec({module!r}) is not None)"
    # Blender and ngpt do not share modules.
    done = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, timeout=60)
    return done.stdout.strip() == "True"


def python_with(module: str) -> str:
    """A Python that has ``module``; the test that asks is skipped where there is none."""
    place = ROOT / ".renderers" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    python = os.environ.get("NGPT_RENDERERS", str(place))
    if not Path(python).is_file():
        pytest.skip(f"{python}: no Python with renderers; see tests/renderers/pythons.py")
    if not _has(python, module):
        pytest.skip(f"{python}: lacks {module}; see tests/renderers/pythons.py")
    return python


def run(module: str, script: str, *arguments: object, **environment: str) -> None:
    """Runs a script of this folder in the Python that has ``module``."""
    command = [python_with(module), "-W", "ignore", HERE / script, *arguments]
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        list(map(str, command)), env=inherited | environment, capture_output=True, text=True, timeout=570
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
