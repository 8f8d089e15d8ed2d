"""References: two halves whose noise is taken off, or one image whose noise is not."""

from pathlib import Path

import numpy as np
import pytest
from folders import evaluated, read, smooth_image, write_halves, write_scene

import ngpt
from ngpt.errors import NgptError
from ngpt.evaluation.references import find_reference, read_reference, reference_noise
from ngpt.measure.metrics import scores

CONFIG = """
scenes = ["{folder}"]
spp = [16]
seeds = 2
methods = ["primal", "l2"]
metrics = ["relMSE", "relMSE trimmed"]
images = "all"
"""


def test_halves_are_found_before_single_images(tmp_path, rng):
    with pytest.raises(NgptError, match="no reference"):
        find_reference(tmp_path)
    # What older versions kept in their caches is one image.
    ngpt.write(tmp_path / "reference-512spp.exr", smooth_image().astype(np.float32))
    assert len(find_reference(tmp_path).images) == 1
    write_halves(tmp_path, rng, 0.1, "reference-512spp")
    found = find_reference(tmp_path)
    assert [Path(file).name for file in found.files] == ["reference-512spp-a.exr", "reference-512spp-b.exr"]
    (tmp_path / "reference-512spp-b.exr").unlink()
    (tmp_path / "reference-512spp.exr").unlink()
    assert len(find_reference(tmp_path).images) == 1


def test_the_same_image_twice_is_refused(tmp_path, rng):
    write_halves(tmp_path, rng, 0.1)
    file = tmp_path / "reference-a.exr"
    with pytest.raises(NgptError, match="are the same image"):
        read_reference([file, file])


def test_noise_and_doubt(tmp_path, rng):
    """The mean of the halves has half their variance; what is left of it in an error is far less than the noise."""
    write_halves(tmp_path, rng, 0.2)
    found = find_reference(tmp_path)
    mean = found.mean
    assert found.noise == pytest.approx(np.mean(0.04 / 2 / (mean**2 + 1e-3)), rel=1e-3)
    assert found.total("ngpt:spp") == 200 and found.total("ngpt:seconds") == 3 and found.total("other") is None
    truth = smooth_image()
    left = [
        np.mean((truth - a) * (truth - b) / (mean**2 + 1e-3))
        for a, b in truth + 0.2 * rng.standard_normal((300, 2, *truth.shape))
    ]
    # Three standard errors, on the safe side: channels are taken to be noisy together.
    assert np.std(left) < found.doubt / 3 < 2 * np.std(left)
    one = read_reference(found.files[:1])
    assert one.noise == reference_noise(one.stacks[0]) and one.doubt == pytest.approx(3 * one.noise)


def test_an_evaluation_measures_by_both_halves(tmp_path, rng):
    """That this takes the noise of the reference off the errors: tests/measure/test_metrics.py."""
    room = tmp_path / "room"
    write_scene(room, rng, spp=(16,))
    write_halves(room, rng, 0.03)
    image, halves = ngpt.denoise(ngpt.read(room / "gradients-16-0.exr"), "l2"), find_reference(room).images
    results = evaluated(read(CONFIG.format(folder=room), tmp_path), tmp_path / "out")
    cell = next(cell for cell in results["cells"] if (cell["method"], cell["seed"]) == ("l2", 0))
    assert len(halves) == 2
    assert cell["metrics"]["relMSE"] == pytest.approx(scores(["relMSE"], image, *halves)["relMSE"], rel=1e-4)
