"""What campaigns leave behind for docs/lab/RELIABILITY.md: how many bad inputs were tried, and what came out."""

import json
import os
import platform
import re
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest

# Module -> package, of what bad inputs go through.
_PACKAGES = {
    name: name for name in ("numpy", "OpenEXR", "onnxruntime", "safetensors", "torch", "mitsuba", "hypothesis")
}
_PACKAGES |= {"ngpt": "ngpt-recon"}


def at_length(*values):
    """A parameter of the long form of a campaign, which `make campaigns` runs; the others belong to `make test`."""
    return pytest.param(*values, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])


def record(campaign: str, tried: int, outcomes: dict[str, int], **more) -> None:
    """Writes one campaign's JSON into the folder that the environment variable NGPT_RELIABILITY names, if it does.

    ``campaign``  what was done, as a reader of the page should see it; also the file's name
    ``tried``     how many times
    ``outcomes``  how often each thing came out; they add up to ``tried``
    ``more``      ``worst`` (name -> value), ``seconds``, and whatever else belongs to it
    """
    assert sum(outcomes.values()) == tried, f"{campaign}: outcomes {outcomes} do not add up to {tried}"
    if folder := os.environ.get("NGPT_RELIABILITY"):
        versions = {package: version(package) for module, package in _PACKAGES.items() if find_spec(module)}
        report = {"campaign": campaign, "tried": tried, "outcomes": outcomes, "worst": {}, "seconds": None}
        report |= more | {"versions": {"python": platform.python_version()} | versions}
        path = Path(folder) / f"{re.sub('[^a-z0-9]+', '-', campaign.lower()).strip('-')}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report, indent=2) + "\n")
