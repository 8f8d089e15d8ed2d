"""What campaigns leave behind for docs/lab/RELIABILITY.md: how many bad inputs were tried, and what came out."""

import json
import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

_PACKAGES = ("ngpt-recon", "numpy", "OpenEXR", "onnxruntime", "safetensors", "torch", "mitsuba", "hypothesis")


def at_length(*values):
    """A parameter of the long form of a campaign, which `make campaigns` runs; the others belong to `make test`."""
    return pytest.param(*values, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])


def record(campaign: str, tried: int, outcomes: dict[str, int], **more) -> Path | None:
    """Writes one campaign's JSON into the folder that the environment variable NGPT_RELIABILITY names, if it does.

    ``campaign``  what was done, as a reader of the page should see it; also the file's name
    ``tried``     how many times
    ``outcomes``  how often each thing came out; they add up to ``tried``
    ``more``      ``worst`` (name -> value), ``seconds``, and whatever else belongs to it

    Returns the file, or None if the variable is not set. A campaign that runs again replaces what it left before.
    """
    if sum(outcomes.values()) != tried:
        raise ValueError(f"{campaign}: outcomes {outcomes} do not add up to {tried}")
    folder = os.environ.get("NGPT_RELIABILITY")
    if not folder:
        return None
    report = {"campaign": campaign, "tried": tried, "outcomes": outcomes, "worst": {}, "seconds": None}
    report |= more | {"versions": versions()}
    path = Path(folder) / f"{re.sub('[^a-z0-9]+', '-', campaign.lower()).strip('-')}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n")
    return path


def versions() -> dict[str, str]:
    """Of Python and of the packages that bad inputs go through, those that are installed."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
