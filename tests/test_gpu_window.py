"""The window on a GPU: split of its time, what it does next, report and parcel; and all of it at a hundredth."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngpt.system.writing import write_json
from scripts.gpu import __main__ as conductor
from scripts.gpu import parcel
from scripts.gpu.recipe import Clock, Recipe, Run, read_recipe

ROOT = Path(__file__).parents[1]
RUNS = (Run("a", "tiny", 0.75, ("run.batch=2",)), Run("b", "tiny", 0.25))
RECIPE = Recipe("cuda_ad_rgb", "cuda", 1.0, 0.2, 0.1, "data-tiny", ("made-00001",), RUNS)


class Program:
    """In place of a program: notes how it was called, and lets the window's time pass."""

    def __init__(self, now, took, statuses, arguments, log, nice=0):
        self.now, self.took, self.arguments, self.log = now, took, arguments, log
        self.seconds, self.running, self.given = 0.0, True, None
        self.status = statuses.get(log.stem, 0)
        if "scripts.gpu.checks" in arguments and not self.status:
            name, file = arguments[2], Path(arguments[-1])
            write_json(file, {"check": name, "status": "passed", "detail": {}, "seconds": 1.0})

    def wait(self, seconds):
        self.given = seconds
        self.seconds = min(self.took.get(self.log.stem, 1.0), seconds)
        self.now[0] += self.seconds
        self.running = self.took.get(self.log.stem, 1.0) > seconds
        return not self.running

    def end(self, grace=0):
        self.running = False

    def last_words(self, lines=3):
        return "its last words"


@pytest.fixture
def window(tmp_path, monkeypatch):
    """Makes windows of a minute whose programs take so many seconds, and end with these statuses (by their logs)."""
    monkeypatch.setattr(conductor, "names", lambda: ["machine", "renderer gpt"])
    monkeypatch.setattr(conductor, "processors", lambda: 1)
    now: list[float] = [0.0]

    def make(took=(), statuses=(), data=("set",), minutes=10.0):
        programs: list[Program] = []

        def start(arguments, log, nice=0):
            programs.append(Program(now, dict(took), dict(statuses), arguments, log, nice))
            return programs[-1]

        monkeypatch.setattr(conductor, "Work", start)
        made = conductor.Window(RECIPE, "window", [tmp_path / d for d in data], tmp_path / "work", minutes)
        made.clock = Clock(minutes, now=lambda: now[0])
        made.run()
        return {program.log.stem: program for program in programs}, made

    return make


def test_recipes_are_whole():
    for name in ("window", "rehearsal"):
        recipe = read_recipe(name)
        assert [run.name for run in recipe.runs] == ["paper", "large"]


@pytest.fixture
def trained(tmp_path):
    """A working folder with a checkpoint of the smallest network, after one step, and shards of 40 kB."""
    torch = pytest.importorskip("torch")
    from ngpt.network.model import Reconstructor
    from ngpt.network.weights import write_tensors
    from ngpt.training.settings import read_settings

    work = tmp_path / "work"
    (work / "runs" / "a").mkdir(parents=True)
    settings = read_settings(ROOT / "configs" / "tiny.toml")
    torch.manual_seed(0)
    state = Reconstructor(settings.model).state_dict()
    tensors = {f"model/{name}": t for name, t in state.items()} | {
        f"average/{name}": t.clone() for name, t in state.items()
    }
    tensors |= {f"{m}/{name}": 1e-9 * torch.rand_like(t) for m in ("adam1", "adam2") for name, t in state.items()}
    header = {"kind": "checkpoint", "step": 7, "seconds": 3.0, "version": "0", "settings": settings.to_dict()}
    write_tensors(work / "runs" / "a" / "checkpoint.safetensors", tensors, header)
    shards = work / "data" / "shards"
    shards.mkdir(parents=True)
    entries = []
    for number in range(4):
        (shards / f"made-{number}.safetensors").write_bytes(bytes(40_000))
        file, crop = f"shards/made-{number}.safetensors", {"spp": [2], "seconds": {}}
        entries.append({"file": file, "sha256": "", "bytes": 40_000, "scene": "m", "crops": [crop], "failures": []})
    manifest = {"format": "ngpt-dataset", "version": 1, "config": {}, "planned": 4, "shards": entries}
    write_json(work / "data" / "manifest.json", manifest)
    return work, tensors


def test_a_parcel_holds_what_fits_and_opens_again(trained, tmp_path):
    from ngpt.network.weights import load_weights, read_tensors

    work, tensors = trained
    out, again = tmp_path / "out", tmp_path / "again"
    out.mkdir()
    left_out = parcel.pack(work, out, piece=0.1, most=0.5)
    pieces = sorted(path.name for path in out.iterdir())
    assert len(pieces) > 2 and max((out / p).stat().st_size for p in pieces) <= 0.1 * 2**20
    # Checkpoints come first, and shards as far as there is room.
    assert left_out and all(name.startswith("data/shards/") for name in left_out) and len(left_out) < 4
    assert parcel.unpack(out, again)
    found, header = read_tensors(again / "runs" / "a" / "checkpoint.safetensors")
    assert header["step"] == 7 and found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert np.allclose(found[name], tensor, rtol=1 / 200, atol=0 if name.startswith("adam") else 1e-7), name
    assert load_weights(again / "runs" / "a" / "weights.safetensors")[1]["training"]["step"] == 7
    listed = json.loads((again / "data" / "manifest.json").read_text())["shards"]
    assert len(listed) == 4 - len(left_out)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_rehearsal_checks_renders_trains_and_goes_on_elsewhere(renderer, tmp_path, monkeypatch):
    """All of it at a hundredth of the scale, the second window on what the first one left."""
    pytest.importorskip("torch")
    # Threads that wait for each other are slow where other processes want the cores as well.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    first, second = tmp_path / "first", tmp_path / "second"
    for number, (work, more) in enumerate(((first, ()), (second, ("--from", str(tmp_path / "out0"))))):
        out = tmp_path / f"out{number}"
        call = ["--recipe", "rehearsal", "--work", str(work), "--out", str(out), "--minutes", "5", *more]
        assert conductor.main(call) == 0
        assert sum(path.stat().st_size for path in out.iterdir()) < 60 * 2**20
    before, after = (json.loads((tmp_path / f"out{i}" / "report.json").read_text()) for i in range(2))
    assert {check["status"] for check in before["checks"]} <= {"passed", "out of time"}
    assert {check["status"] for check in after["checks"]} == {"passed"}
    assert len(after["checks"]) == len(conductor.names()) and len(after["windows"]) == 2
    assert before["crops"] == after["crops"] == {"llvm_ad_rgb": 4}
    for name in ("paper", "large"):
        steps = [report["runs"][name]["checkpoint at step"] for report in (before, after)]
        assert 0 < steps[0] < steps[1], name
        assert (second / "runs" / name / "weights.safetensors").is_file()
    assert after["runs"]["large"]["scores"]
