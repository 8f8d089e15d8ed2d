"""``bench.judging``: cells that go on where a run ended, and errors by references that are known."""

import json

import pytest
from folders import smooth_image

import ngpt
from bench.judging import Cells, Judge
from ngpt.denoisers import oidn
from ngpt.stack import GradientStack


def test_cells_are_written_one_by_one_and_not_measured_twice(tmp_path, capsys):
    file, asked = tmp_path / "cells.json", []

    def measured(scene, known):
        for spp in (4, 16):
            if (scene, spp) not in known:
                asked.append((scene, spp))
                yield {"scene": scene, "spp": spp, "seconds": 2.0}
                assert json.loads(file.read_text())["cells"][-1]["spp"] == spp
                if scene == "stopped":
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Cells(file, "test", ("scene", "spp")).measure(["room", "stopped"], measured)
    cells = Cells(file, "test", ("scene", "spp"))
    cells.measure(["room"], measured)
    assert asked == [("room", 4), ("room", 16), ("stopped", 4)] and len(cells) == 3
    # A cell that is measured again replaces the old one.
    cells.measure(["room"], lambda scene, known: iter([{"scene": "room", "spp": 4, "seconds": 1.0}]))
    assert [(cell["scene"], cell["spp"], cell["seconds"]) for cell in Cells(file, "test", ("scene",))] == [
        ("room", 16, 2.0),
        ("stopped", 4, 2.0),
        ("room", 4, 1.0),
    ]
    assert capsys.readouterr().out.splitlines()[-1] == "room 4 1.00 s"


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_the_steady_error_has_no_noise_of_the_reference(tmp_path, rng):
    clean = smooth_image()
    for half in "ab":
        noisy = clean + rng.normal(0, 0.05, clean.shape)
        ngpt.write(tmp_path / f"room-24x17-{half}.exr", GradientStack.from_arrays(primal=noisy))
    judge = Judge(None, "room", tmp_path, "24x17", 4)
    assert abs(judge.steady(clean)) < 5e-4 < 0.05**2 / 2
    assert judge.steady(1.1 * clean) == pytest.approx(0.01, rel=0.1)
    assert judge.light(1.1 * clean) == pytest.approx(1.1, rel=0.01)
    assert set(judge.values(clean)) == {"error", "FLIP"}
