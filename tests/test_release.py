"""Workflows call what is there, and a release tries every extra."""

import re
import tomllib
from pathlib import Path

from scripts.release import __main__ as release

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_every_extra_for_users_is_tried():
    assert release.TRIALS.keys() == {"", *PROJECT["optional-dependencies"]} - {"dev", "docs", "fuzz"}


def test_workflows_call_what_is_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for workflow in (ROOT / ".github" / "workflows").glob("*.yml"):
        text = workflow.read_text()
        for line in re.findall(r"make ((?:[a-z-]+ ?)+)", text):
            assert set(line.split()) <= targets, line
        for path in re.findall(r"(?:tests|scripts)/[\w/.-]+|\./\.github/\S+", text):
            assert (ROOT / path).exists(), path
        for module in re.findall(r"python -m (scripts[\w.]+)", text):
            assert list(ROOT.glob(f"{module.replace('.', '/')}*")), module
