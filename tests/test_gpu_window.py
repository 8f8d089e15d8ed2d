"""The window on a GPU: split of its time, what it does next, report and parcel; and all of it at a hundredth."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.system.writing import write_json
from scripts.gpu import __main__ as conductor
from scripts.gpu import parcel
from scripts.gpu.recipe import Clock, Recipe, Run, read_recipe, split
from scripts.gpu.report import gather, markdown
from scripts.gpu.work import Work

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


def test_recipes_that_make_no_sense_are_refused(tmp_path):
    text = (ROOT / "scripts" / "gpu" / "window.toml").read_text()
    for old, new, message in (
        ("share = 0.65", "share = 0.75", "add up to 1.1"),
        ("minutes = 9.0", "minutes = 0", "minutes = 0"),
        ("checks = 0.25", "checks = 0.9", "must be below 1"),
        ('config = "large"', 'config = "largest"', "no such file"),
        ('name = "large"', 'name = "paper"', "the same name"),
    ):
        path = tmp_path / "recipe.toml"
        path.write_text(text.replace(old, new))
        with pytest.raises(NgptError, match=message):
            read_recipe(path)


def test_time_is_split_by_shares_and_nothing_is_lost():
    assert split(100, [0.75, 0.25]) == 75
    assert split(40, [0.25]) == 40
    assert split(10, [0.0]) == 0
    clock = Clock(1, closing=20, now=iter([0.0, 30.0, 50.0]).__next__)
    assert clock.seconds == 40 and clock.left == 10 and clock.left == 0


def test_a_window_checks_renders_and_trains(window):
    programs, made = window(took={"crops-gpu": 1e9, "run-a": 1e9, "run-b": 1e9})
    assert list(programs) == ["check-machine", "check-renderer-gpt", "crops-processors", "crops-gpu", "run-a", "run-b"]
    assert programs["crops-gpu"].given == pytest.approx(60)
    left = 600 - 2 - 60
    assert programs["run-a"].given == pytest.approx(0.75 * left) and programs["run-b"].given == pytest.approx(left / 4)
    # The processors render while the GPU trains, another part of the same set.
    both = [programs[name].arguments for name in ("crops-processors", "crops-gpu")]
    assert [call[call.index("--shard") + 1] for call in both] == ["0/2", "1/2"]
    assert not programs["crops-processors"].running
    assert "run.batch=2" in programs["run-a"].arguments
    assert [part["part"] for part in json.loads(made.place.read_text())["parts"]] == [
        *("checks", "crops, gpu", "a", "b", "crops, processors")
    ]


def test_time_that_is_not_needed_goes_to_what_comes_after(window):
    programs, _ = window(took={"crops-gpu": 5, "run-a": 10, "run-b": 1e9})
    assert programs["run-b"].given == pytest.approx(600 - 2 - 5 - 10)


def test_the_next_window_makes_only_the_checks_that_are_missing(window):
    window(took={"check-renderer-gpt": 1e9}, minutes=1)
    programs, made = window(minutes=1)
    assert [name for name in programs if name.startswith("check")] == ["check-renderer-gpt"]
    assert made.record("renderer gpt")["status"] == "passed"
    programs, made = window(minutes=1)
    assert not [name for name in programs if name.startswith("check")]
    assert made.place.name == "002.json"


def test_a_gpu_that_renders_wrong_renders_nothing(window):
    programs, made = window(statuses={"check-renderer-gpt": -6})
    assert made.record("renderer gpt") == {
        "check": "renderer gpt",
        "status": "failed",
        "error": "ended with status -6: its last words",
        "seconds": 1.0,
    }
    assert "crops-gpu" not in programs
    assert "0/1" in programs["crops-processors"].arguments


def test_without_crops_nothing_is_trained(window):
    programs, made = window(data=())
    assert "run-a" not in programs
    assert [part["told"] for part in made.parts if part["part"] == "a"] == [
        "no crops: neither --data nor any that were rendered here in time"
    ]


def set_of(folder, *scenes):
    """A training set as far as its manifest."""
    crop = {"spp": [2], "seconds": {}}
    shards = [
        {"file": f"shards/{s}.safetensors", "sha256": "", "bytes": 1, "scene": s, "crops": [crop], "failures": []}
        for s in scenes
    ]
    folder.mkdir(parents=True, exist_ok=True)
    write_json(
        folder / "manifest.json",
        {"format": "ngpt-dataset", "version": 1, "config": {}, "planned": 4, "shards": shards},
    )


def test_training_waits_for_the_first_crop_where_there_is_no_set(window, tmp_path, monkeypatch):
    """Which a busy machine makes after the share of rendering."""
    looks = iter([{}] * 40)
    monkeypatch.setattr(conductor, "crops", lambda folder: next(looks, {"llvm_ad_rgb": 1}))
    programs, made = window(took={"crops-gpu": 1e9, "crops-processors": 1e9, "run-a": 1e9}, data=())
    assert "run-a" in programs and programs["run-a"].given > 60
    assert programs["crops-gpu"].seconds <= 60
    assert [part["part"] for part in made.parts][:2] == ["checks", "crops, gpu"]


@pytest.mark.parametrize(
    ("scenes", "expected"),
    [
        (("made-00000", "made-00001"), ["made-00001"]),
        (("made-00000",), []),  # the scene that is kept apart is not rendered yet
        (("made-00001",), []),  # nothing else is
    ],
)
def test_scenes_are_kept_apart_as_far_as_they_are_there(window, tmp_path, scenes, expected):
    set_of(tmp_path / "set", *scenes)
    programs, _ = window()
    assert f"data.validation={json.dumps(expected)}" in programs["run-a"].arguments


def test_a_window_that_trains_nothing_is_an_error(tmp_path, monkeypatch, capsys):
    """It says why, and what to do; what was trained before does not count."""
    monkeypatch.setattr(conductor.Window, "run", lambda self: self.note("paper", 0, "no crops"))
    call = ["--recipe", "rehearsal", "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    assert conductor.main(call) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "nothing was trained (paper: no crops); give it more time (--minutes 12)" in error
    counts = iter([3, 3, 3, 4])
    monkeypatch.setattr(conductor, "steps", lambda work: next(counts))
    assert conductor.main(call) == 1
    assert conductor.main(call) == 0


def test_a_program_finds_what_its_starter_finds(tmp_path, monkeypatch):
    """Packages that lie on the path, and are not installed."""
    (tmp_path / "carried.py").write_text("print('found')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    work = Work(["-c", "import carried, scripts.gpu"], tmp_path / "log.txt")
    assert work.wait(60) and work.status == 0 and work.last_words() == "found"


def test_a_program_is_ended_with_all_that_it_started(tmp_path):
    """It is asked first, and may save."""
    code = (
        "import signal, subprocess, sys, time\n"
        "child = subprocess.Popen(['sleep', '100'])\n"
        "def saved(*_):\n    print('saved'); sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, saved)\n"
        "print('started', child.pid, flush=True)\ntime.sleep(100)\n"
    )
    work = Work(["-c", code], tmp_path / "log.txt")
    assert not work.wait(0.1)
    while "started" not in work.last_words():
        assert work.running
    work.end(grace=10)
    assert "saved" in work.last_words() and work.status == 0
    child = int(work.last_words().split()[1])
    state = Path(f"/proc/{child}/stat")
    assert not state.exists() or state.read_text().split()[2] == "Z"


def test_a_program_that_will_not_end_is_killed(tmp_path):
    code = (
        "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('on', flush=True)\ntime.sleep(100)"
    )
    work = Work(["-c", code], tmp_path / "log.txt")
    while work.last_words() != "on":
        assert work.running
    work.end(grace=0.2)
    assert work.status == -9


def test_the_report_names_what_failed(tmp_path):
    (tmp_path / "checks").mkdir()
    write_json(
        tmp_path / "checks" / "onnx.json",
        {"check": "onnx", "status": "not available", "error": "only | CPU", "seconds": 0.5},
    )
    told = gather(tmp_path) | {"left out": ["data/shards/x"]}
    text = markdown(told)
    assert "| onnx | **not available** | 0 | only / CPU |" in text
    assert "No room in the parcel for 1 files: data/shards/x." in text


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


def test_a_parcel_that_lacks_a_piece_is_refused(trained, tmp_path):
    work, _ = trained
    parcel.pack(work, tmp_path, piece=0.1)
    (tmp_path / "kept.001").unlink()
    with pytest.raises(NgptError, match="a piece of the parcel is missing"):
        parcel.unpack(tmp_path, tmp_path / "again")
    assert not parcel.unpack(tmp_path / "nothing", tmp_path / "again")


def test_sets_are_divided_so_that_every_part_has_some_of_all(trained, tmp_path):
    work, _ = trained
    parts = parcel.divide([work / "data"], tmp_path / "sets", most=0.08)
    names = [sorted(path.name for path in (part / "shards").iterdir()) for part in parts]
    assert names == [["made-0.safetensors", "made-2.safetensors"], ["made-1.safetensors", "made-3.safetensors"]]
    with pytest.raises(NgptError, match=r"has a shard of more than 0.01 MiB"):
        parcel.divide([work / "data"], tmp_path / "smaller", most=0.01)


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
