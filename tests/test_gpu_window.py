"""The window on a GPU: what it does in which order, what becomes of programs that fail, and all of it in small."""

import json
import subprocess
import time

import pytest

from scripts import gpu

MANIFEST = {"format": "ngpt-dataset", "version": 1, "config": {}, "planned": 1}


def crops_in(folder, *scenes):
    (folder / "shards").mkdir(parents=True)
    crop = {"spp": [2], "seconds": {}}
    shards = [
        {"file": f"shards/{i}.safetensors", "sha256": "", "bytes": 1, "scene": scene, "crops": [crop], "failures": []}
        for i, scene in enumerate(scenes)
    ]
    (folder / "manifest.json").write_text(json.dumps(MANIFEST | {"shards": shards}))
    return folder


@pytest.fixture
def window(tmp_path, monkeypatch):
    """Runs a window in which programs only note how they are called; what they leave is up to ``does``."""
    monkeypatch.setattr(gpu, "names", lambda: ["renderer gpt", "arrays"])
    (tmp_path / "work" / "checks").mkdir(parents=True)

    def run(*data, passes=(), does=lambda log: None):
        called = {}

        def run_for(seconds, log, *arguments):
            called[log.stem] = seconds, list(map(str, arguments))
            if log.stem in passes:
                record = tmp_path / "work" / "checks" / f"{log.stem.removeprefix('check-')}.json"
                record.write_text('{"check": "renderer gpt", "status": "passed", "seconds": 1, "told": ""}')
            does(log)
            return 1.0, 0, "its last words"

        monkeypatch.setattr(gpu, "run_for", run_for)
        gpu.window(gpu.LARGE, list(data), tmp_path / "work", 10)
        return called

    return run


def test_checks_come_first_then_crops_then_trainings_on_all_there_is(window, tmp_path):
    own = tmp_path / "work" / "data"
    sets = crops_in(tmp_path / "set", "room", "made-00000-x")
    passes = ["check-renderer-gpt"]
    called = window(sets, passes=passes, does=lambda log: crops_in(own, "made-3") if log.stem == "crops" else None)
    assert list(called) == ["check-renderer-gpt", "check-arrays", "crops", "run-paper", "run-large"]
    assert called["crops"][0] == pytest.approx(90) and "cuda_ad_rgb" in called["crops"][1]
    assert called["run-paper"][0] == pytest.approx(0.65 * 580, rel=0.01)
    assert called["run-large"][0] == pytest.approx(580, rel=0.01)  # nothing has taken its time here
    for run in ("run-paper", "run-large"):
        words = called[run][1]
        assert f"data.folders={json.dumps([str(sets), str(own)])}" in words
        assert 'data.validation=["made-00000"]' in words
    # A check is made once; where it leaves no record it has failed.
    assert json.loads((tmp_path / "work" / "checks" / "arrays.json").read_text())["status"] == "failed"
    assert list(window(sets)) == ["crops", "run-paper", "run-large"]


def test_without_crops_nothing_is_trained(window, tmp_path):
    assert list(window()) == ["check-renderer-gpt", "check-arrays", "crops"]
    assert "| paper |  | 0 | no crops |" in (tmp_path / "work" / "report.md").read_text()


def test_processors_render_where_the_gpu_has_not_passed(window):
    assert "llvm_ad_rgb" in window()["crops"][1]


def test_a_window_that_is_cut_has_a_report_of_what_it_did(window, tmp_path):
    def cut(log):
        if log.stem.startswith("run-"):
            raise SystemExit(143)

    with pytest.raises(SystemExit):
        window(crops_in(tmp_path / "set", "room"), does=cut)
    report = (tmp_path / "work" / "report.md").read_text()
    assert "| arrays | failed |" in report and "| crops |" in report and "its last words" in report


def test_a_program_has_its_seconds_and_may_save_what_it_has(tmp_path):
    log = tmp_path / "logs" / "a.txt"
    assert gpu.run_for(60, log, "-c", "print('so far'); raise SystemExit(3)")[1:] == (3, "so far")
    code = "import signal, time\ndef end(*_): print('saved', flush=True); raise SystemExit\n"
    code += "signal.signal(signal.SIGTERM, end)\nprint('begun', flush=True)\ntime.sleep(60)"
    _, status, told = gpu.run_for(2, log, "-c", code)
    assert status is None and told.endswith("saved")


def test_a_program_may_save_where_the_window_itself_is_cut(tmp_path, monkeypatch):
    log, words = (
        tmp_path / "a.txt",
        "import signal, sys, time\nsignal.signal(signal.SIGTERM, lambda *_: sys.exit('saved'))\n",
    )
    wait = subprocess.Popen.wait

    def cut(process, timeout=None):
        if timeout == 60:
            while "begun" not in log.read_text():
                time.sleep(0.01)
            raise SystemExit(143)
        return wait(process, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", cut)
    with pytest.raises(SystemExit):
        gpu.run_for(60, log, "-c", words + "print('begun', flush=True)\ntime.sleep(60)")
    assert "saved" in log.read_text()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--check", "array"], "--check 'array': there are renderer gpt, arrays, networks"),
        (["--minutes", "0"], "--minutes 0: give a number above 0"),
        (["--minutes", "-1"], "--minutes -1: give a number above 0"),
        (["--work", __file__], "no folder can be made there: "),
    ],
)
def test_wrong_arguments_are_refused(tmp_path, capsys, words, complaint):
    with pytest.raises(SystemExit, match="2"):
        gpu.main(["--work", str(tmp_path / "work"), *words])
    assert complaint in capsys.readouterr().err


def test_one_check_says_what_it_found(tmp_path, capsys, monkeypatch):
    for value, status in ((0.1, 0), (0.3, 1)):
        monkeypatch.setitem(gpu.CHECKS_MADE, "arrays", lambda scale, value=value: {"a": (value, 0.2)})
        assert gpu.main(["--small", "--work", str(tmp_path / "work"), "--check", "arrays"]) == status
        assert f"a {value} of 0.2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("found", "status"),
    [
        (lambda scale: {"a": (0.1, 0.2)}, "passed"),
        (lambda scale: {"a": (0.1, 0.2), "b": (0.3, 0.2)}, "failed"),
        (lambda scale: {"a": (float("nan"), 0.2)}, "failed"),
        (lambda scale: __import__("no_such_module"), "not available"),
        (lambda scale: 1 / 0, "failed"),
    ],
)
def test_what_a_check_finds_is_judged(monkeypatch, found, status):
    monkeypatch.setitem(gpu.CHECKS_MADE, "arrays", found)
    assert gpu.check("arrays", gpu.SMALL)["status"] == status


@pytest.mark.parametrize("name", ["arrays", "networks", "training float32"])
def test_checks_pass_where_there_is_nothing_to_find(name, one_thread):
    record = gpu.check(name, gpu.SMALL)
    assert record["status"] == "passed", record


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_rehearsal_checks_renders_trains_and_goes_on(renderer, tmp_path, monkeypatch):
    # Threads that wait for each other are slow where other processes want the cores as well.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    trained = []
    for _ in range(2):
        assert gpu.main(["--small", "--work", str(tmp_path), "--minutes", "5"]) == 0
        trained.append(gpu.steps(tmp_path))
    checks = [json.loads(path.read_text()) for path in tmp_path.glob("checks/*.json")]
    assert 0 < trained[0] < trained[1] and {check["status"] for check in checks} == {"passed"}, checks
    assert "steps/s" in (tmp_path / "report.md").read_text()
