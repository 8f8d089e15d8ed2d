"""The page of a run and the comparison of several, and the best weights."""

import json
import re
from shutil import copytree

import pytest
from crops import SyntheticCrop, trainer

from ngpt.cli import main
from ngpt.network import safetensors
from ngpt.system import configs
from ngpt.training import images
from ngpt.training.run_record import write_record

CROPS = [SyntheticCrop(f"<scene> {i}", i) for i in range(4)]
MODEL = {"network": "dense", "channels": [4], "units": [1], "inputs": ["primal"]}
RUN = {"batch": 1, "log": 1, "save": 2, "validate": 2}


def made(out, steps=6, rate=1e-2):
    """A run of a few steps, with a validation after each second."""
    optimizer = {"learning_rate": rate, "warmup": 1}
    changes = {"model": MODEL, "optimizer": optimizer, "run": RUN | {"steps": steps}}
    run = trainer(out, CROPS[:2], CROPS[2:], augmentation={}, **changes)
    (out / "settings.json").write_text(json.dumps(run.settings.to_dict()))
    write_record(out, run.settings, configs.FOLDER / "tiny.toml", run.model, run.device)
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a finished run, "mine", and what its page held at each step."""
    folder, seen = tmp_path_factory.mktemp("runs"), []
    page = folder / "mine" / "run.html"
    assert made(folder / "mine").run(lambda done, total: seen.append(page.read_text() if page.exists() else ""))
    return folder, seen


def test_a_run_writes_its_page_while_it_goes_on(finished):
    folder, seen = finished[0] / "mine", finished[1]
    assert not seen[1] and "4 steps to go" in seen[3] and 'http-equiv="refresh"' in seen[3]
    text = (folder / "run.html").read_text()
    assert "Finished" in text and 'http-equiv="refresh"' not in text
    # Of what crops are called nothing is markup, nothing is fetched, nothing runs.
    assert "&lt;scene&gt; 3, 32 spp" in text and "<scene>" not in text
    assert "<script" not in text and not re.findall(r"(?:src|href)=\"(?!data:)|url\((?!data:)", text)
    for told in ("what differs from tiny", "optimizer.learning_rate", "memory, MiB", "steps a second", "AMD|Intel|cpu"):
        assert re.search(told, text), told
    log = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert len(log) == 9
    assert all(entry["steps/s"] > 0 and entry["memory MiB"] > 50 for entry in log if "loss" in entry)


def test_the_best_weights_are_kept_and_outlive_a_stop(tmp_path, monkeypatch):
    errors = iter([0.5, 0.2, 0.3, 0.25, 0.1])
    monkeypatch.setattr(
        images, "validate", lambda *_: {"relMSE": next(errors), "relMSE primal": 1.0, "relMSE base": float("nan")}
    )

    def best():
        return safetensors.load_weights(tmp_path / "best.safetensors")[1]["training"]["step"]

    made(tmp_path, steps=6).run()
    assert best() == 4
    for steps, expected in ((8, 4), (10, 10)):
        again = made(tmp_path, steps=steps)
        again.resume()
        again.run()
        assert best() == expected


def test_runs_are_compared(finished, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    copytree(finished[0] / "mine", tmp_path / "fast")
    made(tmp_path / "slow", rate=1e-4).run()
    assert main(["report", "slow", "fast", "-o", "both.html"]) == 0
    text = (tmp_path / "both.html").read_text()
    assert ".plot img { filter: invert" in text  # charts are made for white paper, and the page is dark
    assert "2 training runs" in text and "the same over minutes" in text
    assert re.search(r"<td>\d+ s</td>", text)
    differ = text.partition("Settings that differ")[2].partition("</table>")[0]
    assert re.findall(r'scope="row">([^<]*)', differ) == ["optimizer.learning_rate"]
    assert text.count("(least)") == 1
    # One alone gives the page that the run wrote itself.
    assert main(["report", "fast", "-o", "one.html"]) == 0
    assert "Training run fast" in (tmp_path / "one.html").read_text()
    (tmp_path / "no").mkdir()
    assert main(["report", "fast", "no", "-o", "x.html"]) == 1
    assert "no: holds no log.jsonl" in capsys.readouterr().err
