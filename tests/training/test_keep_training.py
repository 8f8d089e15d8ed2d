"""Training that goes on wherever it was, and stands still while someone measures."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from ngpt.network.safetensors import load_weights
from ngpt.training.settings import read_settings
from scripts import keep_training

ROOT = Path(__file__).parents[2]
HERE = {"cwd": ROOT, "env": os.environ | {"PYTHONPATH": str(ROOT)}}


def test_it_starts_from_the_weights_in_the_repository(tmp_path):
    """Settings that the configuration takes, of the same network."""
    words = keep_training.command("combine", tmp_path, ["run.steps=7"])
    changes = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    settings = read_settings(ROOT / "configs" / "combine.toml", changes)
    assert settings.run.steps == 7 and load_weights(settings.initial)[0].config == settings.model


COUNT = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
while True:
    with open(sys.argv[1], "a") as file: file.write(".")
    time.sleep(0.02)
"""
KEEP = """
import sys
from pathlib import Path
from scripts import keep_training
keep_training.LOOK = 0.02
sys.exit(keep_training.keep([sys.executable, "-c", sys.argv[1], sys.argv[2]], Path(sys.argv[3])))
"""


def test_it_stands_still_while_the_file_is_there(tmp_path):
    marks, busy = tmp_path / "marks", tmp_path / "busy"

    def until(condition):
        deadline = time.monotonic() + 30
        while not condition() and time.monotonic() < deadline:
            time.sleep(0.02)
        assert condition()

    def grows():
        before = marks.stat().st_size if marks.exists() else 0
        time.sleep(0.3)
        return marks.exists() and marks.stat().st_size > before

    words = [sys.executable, "-c", KEEP, COUNT, str(marks), str(busy)]
    with subprocess.Popen(words, **HERE) as process:
        until(grows)
        busy.touch()
        until(lambda: not grows())
        # Ended while it stands still, it wakes up to save.
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 7
