"""Little memory: tiles shrink, and where nothing can be done one line says so."""

import resource
import sys
import time

import numpy as np
import pytest
from full_stack import full_stack
from processes import complete, half_written, one_error
from reliability import record

import ngpt


def address_space_campaign(folder, limits):
    """``ngpt denoise`` of 400x300 pixels within each of those limits, MiB."""
    clock, source = time.monotonic(), folder / "s.exr"
    ngpt.write(source, full_stack(300, 400))
    arguments = [sys.executable, "-m", "ngpt", "denoise", source, "-m", "ngpt-fast", "-o"]
    assert complete([*arguments, folder / "whole.exr"]).returncode == 0
    whole = ngpt.read_image(folder / "whole.exr")
    outcomes, least = {"the same image": 0, "one line": 0}, None
    for mebibytes in limits:
        out = folder / f"{mebibytes}.exr"
        run = complete(
            [*arguments, out],
            preexec_fn=lambda size=mebibytes << 20: resource.setrlimit(resource.RLIMIT_AS, (size, size)),
        )
        if run.returncode == 0:
            assert np.abs(ngpt.read_image(out) - whole).max() <= 1e-5 * whole.max()
            least = min(least or mebibytes, mebibytes)
        else:
            assert run.returncode in (1, 2) and one_error(run.stderr), (mebibytes, run.returncode, run.stderr)
            assert len(run.stderr.splitlines()) == 1, run.stderr
            assert half_written(folder) == [] and not out.exists()
        outcomes["one line" if run.returncode else "the same image"] += 1
    record(
        "Limits of address space on ngpt denoise, 400x300",
        len(limits),
        outcomes,
        worst={"least MiB that gave the image": least},
        seconds=round(time.monotonic() - clock),
    )
    return outcomes


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_limits_of_address_space(tmp_path):
    outcomes = address_space_campaign(tmp_path, [64, 128, 256, 511, *range(512, 1024, 32), 1200, 1600, 2400])
    assert min(outcomes.values()) >= 1
