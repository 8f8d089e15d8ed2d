"""train.py and the configurations that come with it."""

import runpy
import subprocess
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from crops import view

import ngpt
from data_gen.dataset.config import read_config
from ngpt.cli import main
from ngpt.system.templates import entries
from ngpt.training.parameters import TABLES, configuration_row, purpose
from ngpt.training.settings import read_settings

ROOT = Path(__file__).parents[2]
CONFIGS = sorted(path for path in (ROOT / "configs").glob("*.toml") if not path.name.startswith(("data-", "eval-")))
# Those that make images; ``temporal`` learns from shots.
OF_IMAGES = [path for path in CONFIGS if read_settings(path).model]
TRAINING = ROOT / "docs/train/training.md"


def sets(**changes):
    """``table_key=value`` as words of the command."""
    return [word for name, value in changes.items() for word in ("--set", f"{name.replace('_', '.', 1)}={value!r}")]


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture
def train(capsys):
    """Runs train.py in this process: exit status, standard output and error."""
    main = runpy.run_path("train.py")["main"]

    def run(*arguments):
        status = main(list(arguments))
        return status, *capsys.readouterr()

    return run


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_configurations_are_whole(path):
    """And the page of training has their row: what they are for, in their own words, and what they cost."""
    assert path.read_text().startswith("# ") and purpose(path.read_text())
    assert configuration_row(path.stem) in TRAINING.read_text()


@pytest.mark.parametrize("table", TABLES)
def test_every_parameter_has_a_meaning_and_every_meaning_a_parameter(table):
    told = [name for names, meaning in entries(TABLES[table]) for name in names if meaning]
    own = {field.name for field in fields(TABLES[table])} - (set(TABLES) if table == "" else set())
    assert sorted(told) == sorted(own)


def test_a_dry_run_says_what_it_would_cost(train):
    status, output, _ = train("--config", "configs/paper.toml", "--dry-run")
    assert status == 0
    assert "4,358,534" in output and "765.3 G at 1280x720" in output


def test_views_of_ones_own_train_a_network(train, tmp_path):
    for i in range(3):
        crop = view(tmp_path / "views" / f"view{i}", i)
    out, small = tmp_path / "run", [str(tmp_path / "views")]
    words = ["--config", "configs/fast.toml", "--out", str(out)]
    words += sets(data_folders=small, data_validation=["view2"], data_crop=32, model_channels=[4] * 4)
    words += sets(model_units=[1] * 4, run_batch=1, run_precision="float32", optimizer_warmup=1, run_log=1)
    status, output, errors = train(*words, *sets(run_steps=2))
    assert status == 0, errors
    assert "finished at step 2" in output and "relMSE" in output
    # No terminal here: plain lines, beside the log and not in it.
    assert errors.startswith("train: 0/2 steps\n") and "train: 2/2 steps, " in errors and " steps/s" in errors
    _, output, errors = train(*words, *sets(run_steps=3))
    assert "at step 2 of 3" in output and "finished at step 3" in output
    assert errors.startswith("train: 2/3 steps\n") and "train: 3/3 steps, " in errors
    # By name, and without a word.
    words[1] = "fast"
    assert train(*words, *sets(run_steps=4), "-q") == (0, "", "")
    image = ngpt.denoise(crop.stack(0), "ngpt-fast", weights=str(out / "weights.safetensors"))
    assert image.shape == (32, 32, 3)


def test_an_error_of_a_process_that_prepares_examples_is_one_line(train, tmp_path):
    """Crops smaller than examples, which its first example finds."""
    view(tmp_path / "views" / "mine")
    changes = sets(data_folders=[str(tmp_path / "views")], data_workers=1, run_batch=1)
    status, _, errors = train("--config", "tiny", "--out", str(tmp_path / "run"), *changes)
    assert status == 1
    assert errors.splitlines()[-1] == (
        "train.py: error: a crop is 32x32, smaller than the 64 pixels of an example; --set data.crop=32"
    )


def test_the_shipped_network_is_fine_tuned_in_one_command(tmp_path, monkeypatch, capsys):
    """Wherever it is called: the weights that it starts from are found by their name."""
    monkeypatch.chdir(tmp_path)
    crop = view(tmp_path / "views" / "mine")
    changes = sets(data_folders=[str(tmp_path / "views")], data_crop=32, run_steps=1, run_batch=1)
    assert main(["train", "--config", "fine-tune", "--out", "run", *changes]) == 0, capsys.readouterr().err
    ours = ngpt.denoise(crop.stack(0), "ngpt-fast", weights="run/weights.safetensors")
    # One step at a low rate: close to what it started from, and not the same.
    change = np.abs(ours - ngpt.denoise(crop.stack(0), "ngpt-fast"))
    assert 0 < change.mean() < 0.05


@pytest.fixture(scope="module")
def smallest_set(renderer, tmp_path_factory):
    """A folder with the set that the first command of docs/train/training.md makes."""
    folder = tmp_path_factory.mktemp("smallest") / "data"
    assert "    ngpt dataset --config data-tiny --out data " in TRAINING.read_text()
    assert main(["dataset", "--config", "data-tiny", "--out", str(folder), "-q"]) == 0
    return folder


# Others read light in two parts, which that set has not.
TRAINED = [path for path in OF_IMAGES if not {"diffuse", "specular"} & {*read_settings(path).model.inputs}]


# Rendering the set takes twelve processor seconds.
@pytest.mark.slow
@pytest.mark.parametrize("path", TRAINED, ids=lambda path: path.stem)
def test_every_configuration_trains_on_a_set_of_our_own_generator(path, smallest_set, train, tmp_path, one_thread):
    """Only its size is changed. One of the two scenes is set aside, and the command says so."""
    changes = sets(data_folders=[str(smallest_set)], data_crop=48, data_workers=0, run_steps=2)
    changes += sets(run_batch=1, run_views=1)
    status, output, errors = train("--config", path.stem, "--out", str(tmp_path / "run"), *changes)
    assert status == 0, errors
    assert "validation: 1 of 2 scenes set aside" in output and "finished at step 2" in output and "relMSE" in output


@pytest.mark.parametrize(
    ("model", "files"), [("fast", False), ("combine", True), ("primal", True), ("temporal", False)]
)
def test_models_are_made_anew_with_scene_files_and_without(model, files, tmp_path):
    """The script calls a stand-in for Python, in a folder that has scene files or none."""
    calls, python = tmp_path / "calls", tmp_path / "python"
    python.write_text(f'#!/bin/sh\nfor word in "$@"; do printf "%s\\t" "$word"; done >> {calls}; echo >> {calls}\n')
    python.chmod(0o755)
    if files:
        (tmp_path / "scenes" / "bathroom").mkdir(parents=True)
        (tmp_path / "scenes" / "bathroom" / "scene.xml").touch()
    command = ["bash", ROOT / "scripts/train-model", model, "out", "--set", "run.steps=5"]
    subprocess.run(command, cwd=tmp_path, env={"PATH": "/usr/bin:/bin", "PYTHON": str(python)}, check=True)
    *stages, small, whole = (line.split("\t")[:-1] for line in calls.read_text().splitlines())
    made, weights = [], []
    for line in stages:
        if line[0] == "-m":
            made.append(line)
            continue
        if not weights:
            assert any(read_config(each[each.index("--config") + 1]).files for each in made) == files
        changes = [line[i + 1] for i, word in enumerate(line) if word == "--set"]
        settings = read_settings(line[line.index("--config") + 1], changes)
        assert settings.run.steps == 5
        assert settings.data.folders == tuple(each[each.index("--out") + 1] for each in made)
        assert settings.initial == (weights[-1] if weights else "")
        weights.append(f"{line[line.index('--out') + 1]}/weights.safetensors")
        made = []
    assert len(weights) == (2 if model == "primal" else 1) and not made
    # The tuned weights count three times.
    assert small[small.index("--weights") + 1 : small.index("-o")] == weights[:1] + 3 * weights[1:]
    assert small[-1] in whole and whole[-1].endswith(".onnx")
