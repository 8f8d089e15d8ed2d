"""What SECURITY.md promises: nothing is kept in a user's home, and nothing sent, by the libraries that we load."""

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import left_in_home
from traces import spoken_to, traced, written

import ngpt

pytest.importorskip("onnxruntime")

ROOT = Path(__file__).parents[2]
SWITCH = "ORT_DISABLE_TELEMETRY"
DENOISE = """
import numpy as np
import ngpt
from ngpt.stack import GradientStack

image = np.random.default_rng(0).random((16, 24, 3), np.float32)
layers = {name: image for name in ("primal", "dx", "dy", "albedo", "normal")} | {"depth": image[..., :1]}
ngpt.reconstruct(GradientStack(layers), "ngpt-fast")
"""
LOAD = "import onnxruntime"
DATA = "seed = 1\nsize = 32\ninputs = 2\nspp = [2, 4]\nscenes = 2\ncrops = 1\ncrops_per_shard = 1\nreference_spp = 4\n"
CELLS = (
    'scenes = ["diffuse"]\nsize = [24, 16]\nspp = [4]\nseeds = 1\nmethods = ["l2", "ngpt-fast"]\nreference_spp = 16\n'
)
FEW = ["--set", "run.steps=2", "--set", "run.batch=1", "--set", "data.crop=32"]


def fresh(folder: Path, **more: str) -> dict[str, str]:
    """An environment with an empty home and an empty folder for temporary files, which knows nothing of the switch."""
    known = {name: value for name, value in os.environ.items() if name != SWITCH and not name.startswith("XDG_")}
    for name in ("home", "tmp", "work"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    known |= {"HOME": str(folder / "home"), "USERPROFILE": str(folder / "home"), "TMPDIR": str(folder / "tmp")}
    return known | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"} | more


def outside(lines: list[str], folder: Path) -> list[str]:
    """What a command wrote elsewhere than where it works, in the folder for temporary files, and in Dr.Jit's cache."""
    own = [str(folder / name) for name in ("work", "tmp", "home/.drjit")]
    own += ["/dev/null", "/dev/shm", "/dev/tty", "/proc/self", f"{os.sep}proc{os.sep}"]
    return sorted(path for path in written(lines, folder / "work") if not path.startswith(tuple(own)))


def test_denoising_leaves_nothing_in_a_home(tmp_path):
    assert left_in_home(tmp_path, sys.executable, "-c", DENOISE) == []


def test_the_library_alone_would_leave_something(tmp_path):
    """Else the test above could not fail."""
    if left_in_home(tmp_path / "off", sys.executable, "-c", LOAD, **{SWITCH: "1"}):
        pytest.fail(f"{SWITCH}=1 does not turn this version's telemetry off")
    if not left_in_home(tmp_path / "on", sys.executable, "-c", LOAD):
        pytest.skip("this build of ONNX Runtime sends no telemetry")


def test_denoise_writes_its_result_and_speaks_to_nobody(tmp_path, rng):
    environment = fresh(tmp_path)
    layers = {name: rng.gamma(1.0, 1.0, (16, 24, 3)) for name in ("primal", "dx", "dy", "albedo", "normal")}
    stack = ngpt.GradientStack.from_arrays(**layers, depth=np.ones((16, 24)))
    ngpt.write(tmp_path / "work" / "noisy.exr", stack)
    command = [sys.executable, "-m", "ngpt", "denoise", "noisy.exr", "-o", "clean.exr", "-m", "ngpt-fast"]
    lines = traced(command, tmp_path / "work", environment)
    assert str(tmp_path / "work" / "clean.exr") in written(lines, tmp_path / "work")
    assert outside(lines, tmp_path) == [] and spoken_to(lines) == set()
    assert list((tmp_path / "home").iterdir()) == []


@pytest.mark.slow
def test_making_data_training_and_evaluating_write_where_they_should_and_speak_to_nobody(renderer, tmp_path):
    """Dr.Jit keeps compiled kernels in ~/.drjit; nothing else is in a home after it all."""
    pytest.importorskip("torch")
    environment, work = fresh(tmp_path), tmp_path / "work"
    (work / "data.toml").write_text(DATA)
    (work / "cells.toml").write_text(CELLS)
    for arguments in (
        ["dataset", "--config", "data.toml", "--out", "data"],
        ["train", "--config", "tiny", "--out", "run", *FEW],
        ["export", "--weights", "run/weights.safetensors", "-o", "own.onnx", "--vector", "vector"],
        ["evaluate", "--config", "cells.toml", "--out", "cells"],
    ):
        lines = traced([sys.executable, "-m", "ngpt", *arguments], work, environment)
        assert outside(lines, tmp_path) == [] and spoken_to(lines) == set(), arguments
    assert [path.name for path in (tmp_path / "home").iterdir()] == [".drjit"]


@pytest.mark.slow
def test_a_long_program_asks_for_no_address(tmp_path):
    """Events are sent after a minute: that is when the library alone asks for the address of its maker."""
    lines = traced([sys.executable, "-c", f"{DENOISE}\nimport time; time.sleep(80)"], tmp_path, fresh(tmp_path))
    assert spoken_to(lines) == set()


def test_the_runtime_is_loaded_in_one_place_and_examples_turn_it_off():
    loads = re.compile(r"^\s*(?:import|from) onnxruntime\b", re.M)
    files = [
        file for room in ("ngpt", "data_gen", "export", "bench", "scripts") for file in (ROOT / room).rglob("*.py")
    ]
    files = [file for file in files if "node_modules" not in file.parts]
    assert [f.name for f in files if loads.search(f.read_text())] == ["run_onnx.py"]
    for page in [*ROOT.glob("docs/[!l]*/*.md"), *ROOT.glob("export/*.md")]:
        _check_example(page.read_text(), str(page))
    for notebook in ROOT.glob("docs/**/*.ipynb"):
        cells = json.loads(notebook.read_text())["cells"]
        _check_example(
            "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"), str(notebook)
        )
    for host in ("hosts/node/host.mjs", "capi/graph.cpp"):
        assert SWITCH in (ROOT / "export" / host).read_text(), host


def _check_example(text: str, name: str) -> None:
    found = re.search(r"^(?:import|from) .*\bonnxruntime\b", text, re.M)
    assert not found or SWITCH in text[: found.start()], f"{name} loads ONNX Runtime with its telemetry on"
