"""Temporal stability: flicker and bias of known noise, and the pictures beside them."""

import numpy as np
import pytest
from folders import evaluated, read, write_halves, write_scene

from ngpt.errors import NgptError
from ngpt.evaluation.run import picture_path
from ngpt_studies.stability import flicker_and_bias, rolling_shutter, study

CONFIG = """
scenes = ["{folder}"]
spp = {spp}
seeds = 2
methods = ["primal", "l2"]
metrics = ["relMSE", "relMSE trimmed"]
images = "all"
"""


def test_the_noise_of_references_is_taken_off_the_bias(tmp_path, rng):
    """An unbiased method has no bias, even by references with more noise than its mean image."""
    truth = np.ones((40, 50, 3))
    images = truth + rng.normal(0, 0.2, (16, *truth.shape))
    a, b = truth + rng.normal(0, 0.1, (2, *truth.shape))
    assert abs(flicker_and_bias(images, a, b, share=0)["bias"]) < 0.001
    assert flicker_and_bias(images, (a + b) / 2, share=0)["bias"] > 0.004
    write_scene(tmp_path / "room", rng)
    write_halves(tmp_path / "room", rng, 0.1)
    evaluated(read(CONFIG.format(folder=tmp_path / "room", spp=[16]), tmp_path), tmp_path / "out")
    rows = {row["method"]: row for row in study(tmp_path / "out")}
    assert abs(rows["primal"]["bias"]) < 0.003 and rows["primal"]["flicker"] > 0.01


def test_flicker_is_that_of_the_noise(tmp_path, rng):
    write_scene(tmp_path / "room", rng)
    evaluated(read(CONFIG.format(folder=tmp_path / "room", spp=[4, 16]), tmp_path), tmp_path / "out")
    rows = {(r["spp"], r["method"]): r for r in study(tmp_path / "out")}
    # Noise of 0.5 / sqrt(n) on values of about 1.
    assert 4 * rows[16, "primal"]["flicker"] == pytest.approx(rows[4, "primal"]["flicker"], rel=0.2)
    assert rows[4, "l2"]["flicker"] < 0.5 * rows[4, "primal"]["flicker"]
    assert (tmp_path / "out/stability/room-4-l2.png").read_bytes().startswith(b"\x89PNG")
    assert "`primal`" in (tmp_path / "out/stability.md").read_text()
    (tmp_path / "out" / picture_path("room", 4, "l2", 1)).unlink()
    with pytest.raises(NgptError, match=r"4-l2-seed1\.exr: no such picture"):
        study(tmp_path / "out")


def test_flicker_and_bias_add_up(rng):
    reference = np.ones((40, 50, 3))
    images = reference + 0.3 + rng.normal(0, 0.2, (8, 40, 50, 3))
    parts = flicker_and_bias(images, reference, share=0)
    assert parts["bias"] == pytest.approx(0.09 / 1.001, rel=0.03)
    assert parts["flicker"] == pytest.approx(0.04 / 1.001, rel=0.03)
    with pytest.raises(NgptError, match="at least 2 seeds"):
        flicker_and_bias(images[:1], reference)


def test_rolling_shutter_takes_each_row_of_its_seed():
    images = np.arange(3.0)[:, None, None, None] * np.ones((1, 7, 2, 3))
    assert rolling_shutter(images)[:, 0, 0].tolist() == [0, 0, 0, 1, 1, 2, 2]
