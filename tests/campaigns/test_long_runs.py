"""Long runs: as much memory and time for the last file, crop or step as for the first."""

import os
import sys

import numpy as np
import pytest
from full_stack import full_stack
from processes import complete, make_work
from reliability import record

import ngpt

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]

# What a run may gain over its second half. Allocators keep some of what they once had, so it is never quite nothing.
MIB = 16
# What the last quarter may take longer than the one before the middle, in processor time.
SLOWER = 2.0

# Printed by the process itself, one line each: seconds of processor time, and MiB in memory.
NOTE = """
import gc, sys, time
def note():
    resident = int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20
    # Not standard output by its usual name, which is another while a file is read in another thread.
    print("note", time.process_time(), resident, flush=True, file=sys.__stdout__)
def noted(one):
    def call(*arguments, **options):
        try: return one(*arguments, **options)
        finally: note()
    return call
"""
DENOISE = """
import ngpt.cli.denoise as verb
from ngpt.cli import main
verb.write_frame = noted(verb.write_frame)
sys.exit(main(["denoise", sys.argv[1], "-o", sys.argv[2], "-q"]))
"""
GENERATE = """
from dataclasses import replace
from pathlib import Path
from data_gen.dataset import crops, jobs
from data_gen.dataset.config import read_config
config = replace(
    read_config(Path("configs/data-tiny.toml")), size=16, spp=(2, 2), inputs=1, reference_spp=4, crops_per_shard=8,
    scenes=int(sys.argv[2]), crops=int(sys.argv[3]),
)
crops.make_crop = noted(crops.make_crop)
jobs.generate(config, Path(sys.argv[1]), jobs.Serial())
"""
TRAIN = """
import runpy
from ngpt.training.trainer import Trainer
step, count = Trainer._train, 0
def one_of_ten(self, batch):
    global count
    count += 1
    if count % 10 == 0: note()
    return step(self, batch)
Trainer._train = one_of_ten
sys.exit(runpy.run_path("train.py")["main"](sys.argv[1:]))
"""


def notes_of(code, *arguments):
    """Processor seconds and MiB, after each of what a process does many of."""
    run = complete([sys.executable, "-c", NOTE + code, *arguments], timeout=7000)
    assert run.returncode == 0, run.stderr
    lines = [line.split() for line in run.stdout.splitlines() if line.startswith("note ")]
    return np.array([[float(seconds), float(mebibytes)] for _, seconds, mebibytes in lines])


def judge(campaign, notes, each=1):
    """Fails if the second half gains memory, or the last quarter is slow."""
    count = len(notes)
    half, quarter = notes[count // 2 :], count // 4
    slope = np.polyfit(np.arange(len(half)), half[:, 1], 1)[0] * len(half)
    steps = np.diff(notes[:, 0])
    ratio = float(np.median(steps[-quarter:]) / np.median(steps[quarter : 2 * quarter]))
    worst = {
        "MiB gained over the second half": round(float(slope), 2),
        "MiB at its end": round(float(notes[-1, 1])),
        "median time, last quarter by second": round(ratio, 2),
    }
    record(campaign, count * each, {"done": count * each}, worst=worst, seconds=round(float(np.ptp(notes[:, 0]))))
    assert slope < MIB and ratio < SLOWER, worst


def test_many_stacks_in_one_call(tmp_path):
    count = 1000
    (tmp_path / "in").mkdir()
    for i in range(6):
        # Several sizes, since buffers are kept by size; and more files than contents, by links.
        ngpt.write(tmp_path / f"{i}.exr", full_stack(40 + 7 * i, 72 - 5 * i, seed=i))
    for i in range(count):
        os.link(tmp_path / f"{i % 6}.exr", tmp_path / "in" / f"{i:04}.exr")
    notes = notes_of(DENOISE, tmp_path / "in", tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) == len(notes) == count
    judge("Stacks in one call of ngpt denoise", notes)


def test_many_small_crops(tmp_path):
    """A day's generation in small: what a process hoards, it hoards by scenes and crops, not by pixels."""
    pytest.importorskip("mitsuba")
    notes = notes_of(GENERATE, tmp_path / "out", 10, 40)
    assert len(notes) >= 0.9 * 10 * 40, "views that show nothing may fail"
    judge("Small crops in one process of data_gen", notes)


def test_many_training_steps(tmp_path):
    changes = {"run.steps": 5000, "run.save": 1250, "run.validate": 1250, "run.log": 50}
    arguments = make_work("train", tmp_path).arguments(tmp_path / "out", **changes)[2:]
    judge("Training steps of a tiny network", notes_of(TRAIN, *arguments), each=10)
