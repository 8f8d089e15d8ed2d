"""Training sets as Open Image Denoise reads them; rendering is replaced by a stand-in."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from full_stack import full_stack

from ngpt.cli import main
from ngpt.io.exr import read_image
from ngpt.io.openexr import read_exr
from ngpt.training.dataset import Dataset
from ngpt.training.shards import CropData, write_shard

pytest.importorskip("safetensors")
pytest.importorskip("mitsuba")

from data_gen.dataset import jobs

# "Datasets" in the README of Open Image Denoise 2.4.
THEIRS = re.compile(r".+_([0-9]+(spp)?|ref|reference|gt|target)\.(hdr|ldr|sh1[xyz]|alb|nrm)\.exr")
SAMPLES = [2, 16, 16, 300]


def crop(number):
    """A crop with a stack of each of ``SAMPLES``, whose reference is ``number`` + 1."""
    stacks = [full_stack(12, 10, seed=10 * number + k) for k in range(len(SAMPLES))]
    reference = np.full((12, 10, 3), 1 + number, np.float32)
    return CropData([stack.replace(direct=0 * stack["primal"]) for stack in stacks], SAMPLES, reference, 0 * reference)


def stand_in(config, job, folder, variant):
    """As ``jobs.make_shard``: a shard of crops, or of frames where the configuration asks for them."""
    frames = [{"frame": frame} for frame in range(config.frames)] if config.frames > 1 else [{}]
    told = [{"crop": n, "spp": SAMPLES, "seconds": {}} | frame for n in job.crops for frame in frames]
    record = {"scene": job.scene, "crops": told, "failures": []}
    write_shard(Path(folder) / job.file, [crop(each["crop"]) for each in told], record)
    return job.file


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    """Runs ``ngpt dataset --layout oidn`` for three scenes with two crops each; returns its status."""
    monkeypatch.setattr(jobs, "make_shard", stand_in)

    def run(*more, settings="scenes = 3\ncrops = 2\ncrops_per_shard = 2\ninputs = 4\nspp = [2, 300]\n"):
        (tmp_path / "set.toml").write_text(settings)
        files = ["--config", str(tmp_path / "set.toml"), "--out", str(tmp_path / "set")]
        return main(["dataset", *files, "--layout", "oidn", *more])

    return run


def test_names_and_pixels(dataset, tmp_path, capsys):
    assert dataset() == 0
    said = capsys.readouterr().err
    assert "without 6 inputs that have as many samples as another" in said and "python preprocess.py" in said
    root, groups = tmp_path / "set" / "oidn", defaultdict(dict)
    for path in root.rglob("*.exr"):
        assert THEIRS.fullmatch(path.name)
        stem, _, label = path.name.split(".")[0].rpartition("_")
        groups[path.parent.relative_to(root) / stem].setdefault(label, set()).add(path.name.split(".")[1])
    # A scene is on one side only.
    assert sorted({group.parts[:2] for group in groups}) == [
        ("train", "made-00000"),
        ("train", "made-00001"),
        ("valid", "made-00002"),
    ]
    assert len(groups) == 6
    for images in groups.values():
        # They take the last in the order of names for the reference.
        assert sorted(images) == ["0002spp", "0016spp", "0300spp", "ref"]
        assert all(features == {"hdr", "alb", "nrm"} for features in images.values())
    crop, place = Dataset(tmp_path / "set")[3], root / "train" / "made-00001" / "crop0001"
    stacks = [crop.stack(k) for k in range(4)]
    for label, k in (("0002spp", 0), ("0016spp", 1), ("0300spp", 3)):
        assert np.array_equal(read_image(f"{place}_{label}.hdr.exr"), stacks[k]["primal"])
        for feature, layer in (("alb", "albedo"), ("nrm", "normal")):
            assert np.allclose(read_image(f"{place}_{label}.{feature}.exr"), stacks[k][layer], atol=1e-3)
    assert (read_image(f"{place}_ref.hdr.exr") == 2).all()
    mean = sum(n * stack["albedo"] for n, stack in zip(SAMPLES, stacks, strict=True)) / sum(SAMPLES)
    assert np.allclose(read_image(f"{place}_ref.alb.exr"), mean, atol=1e-3)
    (part,) = read_exr(f"{place}_ref.nrm.exr").parts
    assert list(part.channels) == ["B", "G", "R"] and part.channels["R"].dtype == np.float16


def test_parts_write_it_when_all_is_made_and_files_stay(dataset, tmp_path, capsys):
    assert dataset("--shard", "0/2") == 0
    assert "is written when all crops are made; 4 of 6 are" in capsys.readouterr().err
    assert not (tmp_path / "set" / "oidn").exists()
    assert dataset("--shard", "1/2") == 0
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "set" / "oidn").rglob("*.exr")}
    assert len(files) == 72
    lost = min(files)
    lost.unlink()
    assert dataset() == 0
    again = {path: path.stat().st_mtime_ns for path in (tmp_path / "set" / "oidn").rglob("*.exr")}
    assert {path for path in files if files[path] != again[path]} == {lost}


def test_shots_are_refused(dataset, capsys):
    assert dataset(settings="scenes = 1\ncrops = 1\nframes = 2\ninputs = 4\n") == 1
    assert "is a set of shots, and Open Image Denoise trains on single images" in capsys.readouterr().err
