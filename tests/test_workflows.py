"""Workflows call what is there, and every extra of the wheel is tried."""

import re
import tomllib
from pathlib import Path

import pytest

from scripts import wheel

ROOT = Path(__file__).parents[1]


def test_every_extra_for_users_is_tried():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert wheel.TRIALS.keys() == {"", *project["optional-dependencies"]} - {"dev", "docs"}


@pytest.mark.parametrize("workflow", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.stem)
def test_workflows_call_what_is_there(workflow):
    text = workflow.read_text()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    called = {target for line in re.findall(r"make ((?:[a-z-]+ ?)+)", text) for target in line.split()}
    assert called <= targets
    paths = re.findall(r"(?:tests|scripts)/[\w/.-]+|\./\.github/\S+", text)
    assert [path for path in paths if not (ROOT / path).exists()] == []
