"""The replay buffer, fed by a stand-in for rendering."""

import time
from concurrent.futures import ThreadPoolExecutor
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


def stand_in(config, job, folder, variant):
    """One grey crop, of the brightness of its scene's number."""
    number = int(job.scene[-5:])
    grey = np.full((8, 8, 3), number, np.float32)
    names = ("direct", "dx", "dy", "albedo", "normal", "primal_var", "dx_var", "dy_var")
    layers = {"primal": grey, "depth": grey[..., :1]} | dict.fromkeys(names, 0 * grey)
    crop = CropData([GradientStack(layers)], [2], grey, 0 * grey)
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


def test_an_error_of_a_worker_reaches_the_reader(monkeypatch):
    def fail(*_):
        raise NgptError("disk full")

    monkeypatch.setattr(stream, "make_shard", fail)
    with ThreadPoolExecutor(1) as executor, pytest.raises(NgptError, match="disk full"):
        stream.Stream(Config(scenes=1, crops=1), executor).__enter__()
