"""Whole evaluations: of folders of stacks, which need no renderer, and one that renders."""

import csv
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from folders import evaluated, read, write_scene

import ngpt
from data_gen import service
from eval import main as command
from ngpt.errors import NgptError
from ngpt.evaluation import cells, run
from ngpt.io.exr import read_image
from ngpt.system.console import Console
from ngpt.system.files import exclusive

CONFIG = """
scenes = ["{folder}"]
spp = [4, 16]
seeds = 2
methods = ["primal", "l2", "wcv", "nfor", "oracle"]
metrics = ["relMSE", "relMSE trimmed", "PSNR"]
images = "all"
"""


def made(folder):
    """A folder with a scene and the configuration of its evaluation."""
    write_scene(folder / "room", np.random.default_rng(1))
    return folder, read(CONFIG.format(folder=folder / "room"), folder)


@pytest.fixture
def room(tmp_path):
    return made(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The same with its results, in `out`."""
    folder, config = made(tmp_path_factory.mktemp("done"))
    return folder, config, evaluated(config, folder / "out", "the command")


def test_the_folder_of_results(done):
    folder, _, results = done
    out = folder / "out"
    assert results["cells"] == json.loads((out / "results.json").read_text())["cells"]
    found = {(c["spp"], c["method"], c["seed"]): c for c in results["cells"]}
    assert len(found) == len(results["cells"]) == 2 * 2 * 5
    assert all(found[16, m, 0]["metrics"]["relMSE"] < found[4, m, 0]["metrics"]["relMSE"] for m in ("primal", "l2"))
    cell = found[16, "l2", 1]
    assert cell["seconds"]["render"] == pytest.approx(1.6)
    assert cell["seconds"]["total"] == pytest.approx(1.6 + cell["seconds"]["reconstruct"])
    stacks = {"primal": "path", "nfor": "features", "wcv": "gradients"}
    assert all(results["methods"][method]["stack"] == stack for method, stack in stacks.items())
    for cell in results["cells"]:
        if cell["method"] == "oracle":
            assert "unknown method 'oracle'" in cell["absent"]
        else:
            assert not cell["absent"] and read_image(out / cell["image"]).shape == (17, 24, 3)
    means = [row for row in results["summary"] if row["scene"] is None]
    assert {row["method"] for row in means} == {"primal", "l2", "wcv", "nfor"}
    assert any(row["pareto"] for row in results["summary"])
    with open(out / "results.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 20 and float(lines[0]["relMSE"]) == found[4, "primal", 0]["metrics"]["relMSE"]


def test_what_is_done_is_not_done_again_unless_a_stack_changed(done, tmp_path, monkeypatch):
    folder, config, first = done
    shutil.copytree(folder / "out", tmp_path / "out")
    with monkeypatch.context() as patched:
        patched.setattr(cells, "reconstruct", lambda *a, **k: pytest.fail("reconstructed again"))
        assert evaluated(config, tmp_path / "out")["cells"] == first["cells"]
    write_scene(tmp_path / "room", np.random.default_rng(2))
    second = evaluated(replace(config, scenes=(str(tmp_path / "room"),), methods=("primal",)), tmp_path / "out")
    assert first["cells"][0]["metrics"] != second["cells"][0]["metrics"]


def test_killed_half_way_goes_on(room, monkeypatch):
    folder, config = room
    config = replace(config, methods=("primal", "l2", "wcv", "cv"))
    real, calls = cells.reconstruct, []

    def dies(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 7:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(cells, "reconstruct", dies)
    with pytest.raises(KeyboardInterrupt):
        evaluated(config, folder / "out")
    finished = len(list((folder / "out" / "cache" / "cells").glob("*.json")))
    assert finished > 0
    calls[:] = [None] * 8
    results = evaluated(config, folder / "out")
    assert sum(not cell["absent"] for cell in results["cells"]) == 16
    # One warm-up for each method, and the cells that were left.
    assert len(calls) - 8 == 4 + 16 - finished


def brighter(room, factor=8, rows=17):
    image = factor * read_image(room / "reference.exr")[:rows]
    ngpt.write(room / "reference.exr", image, overwrite=True)


# What is done to the folder of a scene -> what is said of it
SPOILT = {
    "hall": (lambda room: None, None),
    "small": (lambda room: brighter(room, 1, 16), "24x17 and 24x16"),
    "bright": (brighter, "3.0 stops brighter"),
    "bare": (lambda room: (room / "reference.exr").unlink(), "no reference"),
    "few": (lambda room: (room / "gradients-16-1.exr").unlink(), "gradients-16-1.exr: no such stack"),
}


def test_bad_scenes_are_named_and_the_others_go_on(tmp_path, rng):
    for name, (spoil, _) in SPOILT.items():
        write_scene(tmp_path / name, rng, spp=(16,))
        spoil(tmp_path / name)
    scenes = ", ".join(f'"{tmp_path}/{name}"' for name in SPOILT)
    config = replace(read(CONFIG.replace('"{folder}"', scenes), tmp_path), spp=(16,), methods=("l2",))
    cells = evaluated(config, tmp_path / "out")["cells"]
    for name, (_, message) in SPOILT.items():
        told = [cell["absent"] for cell in cells if cell["scene"] == name]
        assert not any(told) if message is None else any(words and message in words for words in told), name


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('scenes = ["{folder}/room", "none.xml"]', "none.xml: no such file, nor a built-in scene"),
        ('scenes = ["{folder}/room", "difuse"]', "difuse: no such file, nor a built-in scene; did you mean 'diffuse'?"),
        ('[references]\nroom = ["{folder}/room/reference.exr", "no.exr"]', "no.exr: no such file; evaluation: refer"),
        ('scenes = ["{folder}/room", "diffuse"]\nclock = "gtp"', "evaluation: clock: unknown sampler 'gtp'; did you"),
        ('scenes = ["diffuse"]\nreference_sampler = "gtp"', "evaluation: reference_sampler: unknown sampler 'gtp'"),
    ],
)
def test_what_does_not_exist_is_refused_before_any_work(renderer, room, monkeypatch, entry, message):
    folder, _ = room
    monkeypatch.setattr(run, "SceneStacks", lambda *_: pytest.fail("work was done"))
    scenes = "" if "scenes" in entry else 'scenes = ["{folder}/room"]\n'
    config = read((scenes + entry + "\n").replace("{folder}", str(folder)), folder)
    with pytest.raises(NgptError) as error:
        evaluated(config, folder / "new")
    assert message in str(error.value) and not (folder / "new").exists()


def test_a_cache_that_cannot_be_made_is_named(room):
    folder, config = room
    (folder / "file").touch()
    with pytest.raises(NgptError, match=r"file/cells: cannot be made: .*; name another folder"):
        run.evaluate(config, folder / "new", Console(quiet=True), "", service, folder / "file")


def test_weights_that_cannot_be_loaded_are_said_before_any_work(tmp_path):
    (tmp_path / "cut.onnx").write_bytes(b"cut")
    text = f'methods = ["x"]\n[variants.x]\nmethod = "ngpt"\nweights = "{tmp_path / "cut.onnx"}"\n'
    (column,) = read(text, tmp_path).columns()
    assert "cut.onnx: ONNX Runtime cannot load it" in cells.absence(column)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("colour = 1", "unknown key 'colour'"),
        ("spp = [4.5]", "spp = [4.5]: must be a list of whole numbers"),
        ("seeds = 0", "must be at least 1"),
        ('metrics = ["beauty"]', "no metric 'beauty'"),
        ('primary = "SSIM"', "primary = 'SSIM' is not among metrics"),
        ('methods = ["l1", "l1"]', "listed twice"),
        ('images = "some"', "images = 'some'"),
        ('[variants.x]\nstack = "left"\nmethod = "l1"', "stack must be one of"),
        ("[variants.x]\nalpha = 1", "variants.x: method is missing"),
        ('[variants.x]\nmethod = "l1"\nalhpa = 1', "method 'l1' has no option 'alhpa'; did you mean 'alpha'?"),
        ('[variants.x]\nmethod = "l1"\nalpha = "much"', "method 'l1', option 'alpha': 'much' is not allowed"),
        ('samplers = ["gpt", "gpt"]', "a sampler is listed twice"),
        ("rivals = [1]", "must be a list of str"),
        (
            'methods = ["l1", "l1-gpt"]\nsamplers = ["gpt", "toy"]\n'
            '[variants.l1-gpt]\nmethod = "l1"\nsampler = "primal"',
            "two columns would be called 'l1-gpt'",
        ),
        ('[references]\nroom = ["a.exr"]', "references.room = ['a.exr']: must be a file, or a list of two files"),
        ('[against]\noidn = ["oidm"]', "against.oidn: there is no column 'oidm' among: primal, l1, wcv"),
    ],
)
def test_errors_of_the_configuration(tmp_path, entry, message):
    text = f'scenes = ["diffuse"]\n{entry}\n'
    if entry.startswith("primary"):
        text += 'metrics = ["relMSE"]\n'
    with pytest.raises(NgptError) as error:
        read(text, tmp_path)
    assert message in str(error.value) and "config.toml" in str(error.value)


def test_a_configuration_may_build_on_another(tmp_path):
    (tmp_path / "main.toml").write_text('scenes = ["diffuse"]\nspp = [4]\nseeds = 2\n[groups]\nrooms = ["room"]\n')
    config = read('base = "main.toml"\nspp = [8]\nscenes = []\n[groups]\nhalls = ["hall"]\n', tmp_path)
    assert (config.spp, config.seeds, config.scenes) == ((8,), 2, ())
    assert config.groups == {"rooms": ["room"], "halls": ["hall"]}  # tables are put together
    with pytest.raises(NgptError, match="no scenes: name built-in ones"):
        config.scene_files()
    with pytest.raises(NgptError, match=r"none\.toml: not found"):
        read('base = "none.toml"\n', tmp_path)
    (tmp_path / "main.toml").write_text('base = "config.toml"\n')
    with pytest.raises(NgptError, match=r"main\.toml: base = 'config\.toml': .* which is not built on this one"):
        read('base = "main.toml"\n', tmp_path)


def test_the_command(room, capsys):
    folder, _ = room
    read('methods = ["primal"]'.join(re.split("methods = .*", CONFIG.format(folder=folder / "room"))), folder)
    out = folder / "out"
    write_scene(folder / "hall", np.random.default_rng(1))
    arguments = ["--config", str(folder / "config.toml"), "--out", str(out), "--scenes", str(folder / "hall"), "-q"]
    assert command(arguments) == 0
    results = json.loads((out / "results.json").read_text())
    assert set(results["scenes"]) == {"room", "hall"} and "--scenes" in results["command"]
    assert command(["--config", str(folder / "none.toml"), "--out", str(out)]) == 1
    assert "none.toml: cannot be read" in capsys.readouterr().err
    with exclusive(out):
        assert command(arguments) == 1
    assert "another process is writing there" in capsys.readouterr().err
    (folder / "hall" / "reference.exr").unlink()
    assert command(arguments) == 1
