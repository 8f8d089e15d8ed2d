"""Broken files by the dozen, and by the ten thousand in `make campaigns`: each is refused by name or handled.

Where a test fails, Hypothesis has looked for a small change that fails: the last file in the test's folder.
"""

import resource
import time
from collections import Counter
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
from broken_files import TARGETS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reliability import at_length, record

from ngpt.errors import NgptError

# Target: what it is to a reader, files in the long form, what it needs beyond the base.
TEXTS = {
    "exr": ("OpenEXR stacks, mutated: read, reconstructed, written", 10_000, ()),
    "foreign": ("PFM, HDR, PNG, TIFF, JPEG, mutated: read", 10_000, ("PIL", "tifffile")),
    "manifest": ("Manifests of training sets, mutated", 5000, ("safetensors",)),
    "shard": ("Shards of training sets, mutated, with a checksum that fits", 5000, ("safetensors",)),
    "settings": ("Settings of training and data generation, mutated", 5000, ("torch",)),
    "weights": ("Weights, mutated", 5000, ("torch", "safetensors")),
    "network": ("ONNX networks given by users, mutated", 1000, ("onnx",)),
}
# Processor time and memory that one file of some kB may take
SECONDS, MEBIBYTES = 5.0, 512


@contextmanager
def little_memory():
    """No call gets more than 1 GiB of address space beyond what the process has."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (int((status("VmSize") + 2 * MEBIBYTES) * 2**20), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def status(name):
    """MiB, by what the system says of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))


@pytest.mark.parametrize(
    ("target", "count"),
    [
        *((target, 100) for target in ("exr", "foreign", "manifest", "shard")),
        *(at_length(target, many) for target, (_, many, _) in TEXTS.items()),
    ],
)
def test_broken_files_are_refused_or_handled(target, count, tmp_path):
    (text, many, needs), run = TEXTS[target], TARGETS[target]
    for package in needs:
        pytest.importorskip(package)
    # A whole file is accepted. This also imports what is needed, and starts threads.
    run(None, tmp_path)
    outcomes, worst, begun = Counter(), Counter(), time.perf_counter()

    @settings(
        max_examples=count, derandomize=count < many, database=None, deadline=timedelta(minutes=1),
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.randoms(use_true_random=False))
    def try_them(rng):
        # The system forgets the largest size so far.
        Path("/proc/self/clear_refs").write_text("5")
        before, clock = status("VmRSS"), time.process_time()
        try:
            run(rng, tmp_path)
            outcome = "accepted"
        except NgptError as error:
            message, outcome = str(error), "named error"
            assert str(tmp_path) in message and "\n" not in message and len(message) <= 1000
        found = {"seconds": time.process_time() - clock, "MiB": status("VmHWM") - before}
        assert found["seconds"] < SECONDS and found["MiB"] < MEBIBYTES
        outcomes[outcome] += 1
        worst.update({what: max(0, value - worst[what]) for what, value in found.items()})

    with little_memory():
        try_them()
    tried = outcomes.total()
    assert outcomes["named error"] > tried / 10 and outcomes["accepted"] > tried / 100, "does it work?"
    worst = {what: round(value, 4) for what, value in worst.items()}
    record(text, tried, dict(outcomes), worst=worst, seconds=round(time.perf_counter() - begun, 1))
