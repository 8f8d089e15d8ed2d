"""The window on a GPU: its checks, the time that a program has, and all of it in small."""

import json

import pytest

from scripts import gpu


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


@pytest.mark.parametrize("name", ["arrays", "networks", pytest.param("training float32", marks=pytest.mark.slow)])
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
