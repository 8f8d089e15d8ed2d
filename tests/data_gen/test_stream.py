"""The replay buffer, fed by a stand-in for rendering."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.training.shards import CropData, write_shard

pytest.importorskip("safetensors")
pytest.importorskip("mitsuba")

from data_gen.dataset import stream
from data_gen.dataset.config import Config
from data_gen.dataset.kept import home


def stand_in(config, job, folder, variant, again=None):
    """One grey crop, as bright as its scene's number; its input is 1 brighter where the reference was kept."""
    number = int(job.scene[-5:])
    grey = np.full((8, 8, 3), number, np.float32)
    names = ("direct", "dx", "dy", "albedo", "normal", "primal_var", "dx_var", "dy_var")
    layers = {"primal": grey, "depth": grey[..., :1]} | dict.fromkeys(names, 0 * grey)
    stack = GradientStack(layers)
    crop = CropData([stack.replace(primal=grey + 1) if again else stack], [2], grey, 0 * grey)
    write_shard(Path(folder) / job.file, [crop], {"scene": job.scene, "crops": [{"spp": [2]}]})
    return job.file


def test_new_crops_replace_old_ones(monkeypatch):
    monkeypatch.setattr(stream, "make_shard", stand_in)
    with ThreadPoolExecutor(2) as executor, stream.Stream(Config(scenes=1, crops=1), executor, capacity=4) as data:
        first = data[0]
        deadline = time.monotonic() + 20
        while max(data.scenes) < "made-00010" and time.monotonic() < deadline:
            time.sleep(0.02)
        assert len(data) == 4 and max(data.scenes) >= "made-00010"
        assert first.scene not in data.scenes
        # It has left the buffer, but who holds it can still read it.
        assert np.all(first.reference == int(first.scene[-5:]))
        assert np.all(first.stack(0)["primal"] == int(first.scene[-5:]))


def test_kept_references_are_met_again_with_new_inputs(monkeypatch, tmp_path):
    monkeypatch.setattr(stream, "make_shard", stand_in)
    config = Config(scenes=3, crops=1, size=8)
    with ThreadPoolExecutor(1) as executor, stream.Stream(config, executor, capacity=3, kept=tmp_path) as data:
        deadline = time.monotonic() + 20
        while any(np.all(crop.stack(0)["primal"] == crop.reference) for crop in data) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert {crop.scene for crop in data} <= {"made-00000", "made-00001", "made-00002"}
        assert all(np.all(crop.stack(0)["primal"] == crop.reference + 1) for crop in data)
    assert len(list(tmp_path.rglob("*.safetensors"))) == 3
    # Another configuration has others, one with other inputs the same.
    assert (
        home(config, tmp_path) == home(replace(config, spp=(3, 9)), tmp_path) != home(replace(config, seed=1), tmp_path)
    )


def test_an_error_of_a_worker_reaches_the_reader(monkeypatch):
    def fail(*_):
        raise NgptError("disk full")

    monkeypatch.setattr(stream, "make_shard", fail)
    with ThreadPoolExecutor(1) as executor, pytest.raises(NgptError, match="disk full"):
        stream.Stream(Config(scenes=1, crops=1), executor).__enter__()
