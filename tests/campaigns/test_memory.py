"""Little memory: the image or one line within limits of address space."""

import resource
import sys
import time

import numpy as np
import pytest
from full_stack import full_stack
from processes import NGPT, complete, half_written, one_error
from reliability import record

import ngpt

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="limits and /proc of Linux")]


@pytest.mark.timeout(3600)
def test_limits_of_address_space(tmp_path):
    """``ngpt denoise`` of 400x300 pixels within each of those limits, MiB."""
    limits = [64, 128, 256, 511, *range(512, 1024, 32), 1200, 1600, 2400]
    clock, source = time.monotonic(), tmp_path / "s.exr"
    ngpt.write(source, full_stack(300, 400))
    arguments = [*NGPT, "denoise", source, "-m", "ngpt-fast", "-o"]
    assert complete([*arguments, tmp_path / "whole.exr"]).returncode == 0
    whole = ngpt.read_image(tmp_path / "whole.exr")
    enough = []
    for mebibytes in limits:
        out, size = tmp_path / f"{mebibytes}.exr", mebibytes << 20
        limit = (resource.RLIMIT_AS, (size, size))
        run = complete([*arguments, out], preexec_fn=lambda limit=limit: resource.setrlimit(*limit))
        if run.returncode == 0:
            assert np.abs(ngpt.read_image(out) - whole).max() <= 1e-5 * whole.max()
            enough.append(mebibytes)
        else:
            assert run.returncode in (1, 2) and one_error(run.stderr), (mebibytes, run.returncode, run.stderr)
            assert len(run.stderr.splitlines()) == 1, run.stderr
            assert half_written(tmp_path) == [] and not out.exists()
    assert 1 <= len(enough) < len(limits)
    record(
        "Limits of address space on ngpt denoise, 400x300",
        len(limits),
        {"the same image": len(enough), "one line": len(limits) - len(enough)},
        worst={"least MiB that gave the image": min(enough)},
        seconds=round(time.monotonic() - clock),
    )
