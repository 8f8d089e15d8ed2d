"""Broken files by the hundred, and by the ten thousand in `make campaigns`: each is refused by name or handled.

A failure names inputs by number: `python tests/campaigns/fuzz/campaign.py TARGET --replay NUMBER` does it again.
"""

import re
import sys
from pathlib import Path

import pytest
from fuzz.campaign import run
from processes import ENVIRONMENT, ROOT, complete
from reliability import at_length, record

# Target: what it is to a reader, inputs here, inputs in the slow campaign, what it needs beyond the base.
TARGETS = {
    "exr": ("OpenEXR stacks, mutated: read, reconstructed, written", 250, 10_000, ()),
    "foreign": ("PFM, HDR, PNG, TIFF, JPEG, mutated: read", 300, 10_000, ("PIL", "tifffile")),
    "manifest": ("Manifests of training sets, mutated", 150, 5000, ("safetensors",)),
    "shard": ("Shards of training sets, mutated, with a checksum that fits", 150, 5000, ("safetensors",)),
    "settings": ("Settings of training and data generation, mutated", 150, 5000, ("torch",)),
    "weights": ("Weights, mutated", 80, 5000, ("torch", "safetensors")),
    "checkpoint": ("Checkpoints of training, mutated", 80, 5000, ("torch", "safetensors")),
    "network": ("ONNX networks given by users, mutated", 40, 1000, ("onnx",)),
}


@pytest.mark.parametrize(
    ("target", "first", "count"),
    [
        *((target, 0, few) for target, (_, few, _, _) in TARGETS.items()),
        *(at_length(target, 1000, many) for target, (_, _, many, _) in TARGETS.items()),
    ],
)
def test_broken_inputs_are_refused_or_handled(target, first, count):
    text, _, _, needs = TARGETS[target]
    for package in needs:
        pytest.importorskip(package)
    report = run(target, first, count)
    assert not report.failures, report.failures
    assert report.outcomes["named error"] > count / 10 and report.outcomes["accepted"] > count / 100, "does it work?"
    assert report.outcomes.total() == count
    record(text, count, dict(report.outcomes), worst=report.worst, seconds=round(report.seconds, 1))


@pytest.mark.parametrize("target", [at_length("header"), at_length("json"), at_length("toml")])
def test_bytes_that_reach_new_lines(target, tmp_path):
    """A minute of libFuzzer for each of the parsers in Python."""
    pytest.importorskip("atheris")
    command = [sys.executable, Path(__file__).parent / "fuzz" / "coverage_guided.py", target, "-max_total_time=60"]
    done = complete(command, cwd=tmp_path, env=ENVIRONMENT | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"})
    assert done.returncode == 0, done.stderr[-2000:]
    runs = int(re.search(r"Done (\d+) runs", done.stderr)[1])
    record(f"Coverage-guided bytes: {target}", runs, {"named error or accepted": runs}, seconds=60)
