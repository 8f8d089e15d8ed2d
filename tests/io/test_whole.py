"""Whole files are told from cut ones by their tables."""

import os

import numpy as np
import OpenEXR
import pytest
from exr_files import write_levels, write_raw
from full_stack import full_stack

import ngpt
from ngpt.io.whole import finished

PIXELS = np.random.default_rng(3).random((70, 50)).astype(np.float32)


def parts(path, *sizes):
    """Parts of lines, 0, or of tiles of so many pixels."""
    made = []
    for i, size in enumerate(sizes):
        described = OpenEXR.TileDescription()
        described.xSize, described.ySize = size, 2 * size
        header = {"type": OpenEXR.tiledimage, "tiles": described} if size else {}
        made.append(({"Y": PIXELS}, header, "ab"[i] if len(sizes) > 1 else ""))
    write_raw(path, *made)


MAKERS = {
    "lines": lambda path: ngpt.write(path, full_stack(40, 50, seed=1)),
    "tiles": lambda path: parts(path, 16),
    "parts": lambda path: parts(path, 0, 16),
    "levels": lambda path: write_levels(path, np.ones((4, 4, 3)), rip=False),
}


@pytest.mark.parametrize("make", MAKERS)
def test_a_file_is_finished_and_no_beginning_of_it_is(tmp_path, make):
    path = tmp_path / "a.exr"
    MAKERS[make](path)
    assert finished(path)
    data = path.read_bytes()
    # The smaller levels, which nobody reads, may be cut.
    least = 0.8 if make == "levels" else 1.0
    for size in [0, 3, 8, *np.linspace(9, least * len(data) - 1, 30).astype(int)]:
        path.write_bytes(data[:size])
        assert not finished(path), f"{size} of {len(data)} bytes"
    path.unlink()
    assert not finished(path)


def test_what_is_no_file_is_not_ours_to_replace(tmp_path):
    os.mkfifo(tmp_path / "pipe.exr")
    assert finished(tmp_path / "pipe.exr") and finished(tmp_path)
