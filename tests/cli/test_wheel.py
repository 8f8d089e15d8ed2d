"""The wheel: what it holds, and that it does everything in a fresh virtual environment, far from the repository."""

import json
import os
import re
import subprocess
import sys
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

pytest.importorskip("hatchling")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of the working tree."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def held(wheel):
    """The names of its files."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def metadata(wheel, held):
    (name,) = (name for name in held if name.endswith("/METADATA"))
    with zipfile.ZipFile(wheel) as archive:
        return Parser().parsestr(archive.read(name).decode())


def test_it_holds_the_two_packages_and_the_configurations(held):
    files = [path for room in ("ngpt", "data_gen") for path in (ROOT / room).rglob("*") if path.is_file()]
    packages = {path.relative_to(ROOT).as_posix() for path in files if path.parent.name != "__pycache__"}
    configs = {f"ngpt/configs/{path.name}" for path in (ROOT / "configs").iterdir()}
    weights = {f"ngpt/weights/{path.name}" for path in (ROOT / "export" / "weights").iterdir()}
    assert {name for name in held if "dist-info" not in name} == packages | configs | weights
    assert {"ngpt/py.typed", "ngpt/report/report.html", "ngpt/measure/layers.json"} <= packages
    assert "ngpt/configs/tiny.toml" in configs


def test_it_holds_networks_in_the_form_that_runs_without_extras_and_in_the_one_that_training_starts_from(held):
    networks = {name for name in held if name.startswith("ngpt/weights/")}
    run = {name for name in networks if name.endswith(".onnx")}
    trained = {f"ngpt/weights/{path.name}" for path in (ROOT / "export" / "weights").iterdir()}
    assert len(run) >= 6 and len(trained) >= 4 and networks == run | trained


def test_it_is_light_without_extras_and_whole_with_train(metadata):
    needs = [
        re.match(r"([\w-]+)(?:\[([\w,]+)\])?[^;]*(?:; extra == '(\w+)')?", n) for n in metadata.get_all("Requires-Dist")
    ]
    base = {"filelock", "mitsuba-oidn", "numpy", "onnxruntime", "openexr", "rich", "scipy"}
    assert {n[1].lower() for n in needs if not n[3]} == base

    def brought(extra):
        ours = [n for n in needs if n[3] == extra]
        further = [brought(other) for n in ours if n[1] == "ngpt-recon" for other in n[2].split(",")]
        return {n[1] for n in ours if n[1] != "ngpt-recon"}.union(*further)

    assert brought("train") == {"mitsuba", "onnx", "onnxscript", "safetensors", "tensorboard", "torch"}
    assert metadata["Description-Content-Type"] == "text/markdown" and "# ngpt" in metadata.get_payload()


def test_what_renders_comes_by_entry_points(wheel, tmp_path):
    """Of the wheel alone: not those of the checkout's installation."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "from importlib.metadata import distributions; from ngpt.cli import all_verbs\n"
        f"(own,) = [d for d in distributions(path=[{str(tmp_path / 'site')!r}])]\n"
        "print(sorted((e.group, e.value) for e in own.entry_points), 'render' in all_verbs())"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    told = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, env=environment, text=True)
    assert "('ngpt.verbs', 'data_gen.cli:VERBS')" in told and "('ngpt.renderers', 'data_gen.service')" in told
    assert told.endswith("True\n")


def test_its_configurations_and_weights_are_found_by_name(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = "from ngpt.system.configs import DATASET, find_config; print(find_config('data-tiny', DATASET))"
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    told = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, env=environment, text=True)
    assert Path(told.strip()) == tmp_path / "site" / "ngpt" / "configs" / "data-tiny.toml"
    code = "from ngpt.network import weights as w; w.load_weights('ngpt-fast'); print(w.shipped()['ngpt-fast'])"
    told = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, env=environment, text=True)
    assert Path(told.strip()) == tmp_path / "site" / "ngpt" / "weights" / "ngpt-fast.safetensors"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_it_makes_data_trains_evaluates_and_exports(renderer, wheel, tmp_path):
    """Needs a package index, and 1.5 GB of disk for a while."""
    venv.create(tmp_path / "venv", with_pip=True)
    programs = tmp_path / "venv" / "bin"
    work = tmp_path / "work"
    work.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= {"OMP_NUM_THREADS": "1", "PATH": f"{programs}:{os.environ['PATH']}"}

    def run(*words):
        done = subprocess.run(words, cwd=work, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (words, done.stdout[-2000:], done.stderr[-2000:])
        return done.stdout

    run(programs / "pip", "install", "-q", "-c", ROOT / "constraints.txt", f"{wheel}[train]")
    ngpt = programs / "ngpt"
    run(ngpt, "dataset", "--config", "data-tiny", "--out", "data")
    few = ["--set", "run.steps=4", "--set", "run.batch=2"]
    run(ngpt, "train", "--config", "tiny", "--out", "run", *few)
    run(ngpt, "export", "--weights", "run/weights.safetensors", "-o", "mine.onnx")
    (work / "tiny.toml").write_text(
        'scenes = ["diffuse"]\nsize = [24, 16]\nspp = [4]\nseeds = 1\nmethods = ["l2", "mine"]\nreference_spp = 16\n'
        '[variants.mine]\nmethod = "ngpt"\nweights = "mine.onnx"\n'
    )
    run(ngpt, "evaluate", "--config", "tiny.toml", "--out", "own")
    cells = json.loads((work / "own" / "results.json").read_text())["cells"]
    assert {cell["method"] for cell in cells if not cell["absent"]} == {"l2", "mine"}
    run(ngpt, "evaluate", "--config", "eval-tiny", "--out", "shipped")
    results = json.loads((work / "shipped" / "results.json").read_text())
    assert results["command"] == "ngpt evaluate --config eval-tiny --out shipped"
    # What compares with others is in an extra of its own, and its absence is told.
    absent = {cell["method"]: cell["absent"] for cell in results["cells"] if cell["absent"]}
    assert "nlm" in absent and "oidn" not in absent and all("scikit-image" in why for why in absent.values())
    told = run(programs / "python", "-c", "import ngpt, data_gen; print(ngpt.__file__, data_gen.__file__)")
    assert str(ROOT) not in told
