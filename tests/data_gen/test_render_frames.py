"""``ngpt render --frames``: frames, patterns, going on."""

import argparse
import json
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import ngpt
from data_gen.cli.render_arguments import frames, targets
from data_gen.pattern import filled
from ngpt.errors import NgptError
from ngpt.system.console import Console
from ngpt.system.interrupts import Interrupt

pytest.importorskip("mitsuba")

from data_gen import shot_files
from data_gen.cli import render
from data_gen.dataset import jobs


def test_frames_are_ranges_lists_and_steps():
    assert frames("0:3") == [0, 1, 2] and frames("0:10:4") == [0, 4, 8] and frames("7") == [7]
    assert frames("1-3") == [1, 2, 3] and frames("1-9x4,20") == [1, 5, 9, 20] and frames("-2--1") == [-2, -1]
    assert frames("7-7:2") == [7] and frames("3-1:-1") == [3, 2, 1]
    assert frames("1,5:7,5") == [1, 5, 6] and frames("-2:1") == [-2, -1, 0] and frames("3:0:-1") == [3, 2, 1]


@pytest.mark.parametrize("text", ["", "a", "1:2:3:4", "3:3", "0:5:0", "1.5", "0:10000000"])
def test_frames_that_make_no_sense_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError):
        frames(text)


def test_text_changes_from_frame_to_frame():
    assert filled("{frame}", 7) == "7" and filled("shot.{frame:04d}.exr", 7) == "shot.0007.exr"
    assert filled("{10 + frame * 1.5:.2f},0", 3) == "14.50,0" and filled("{sin(pi * frame / 2):.1f}", 1) == "1.0"
    assert filled("{frame:*>8.3f}|{frame:+,d}|{frame:#x}|{frame:99}", 4000)[:22] == "4000.000|+4,000|0xfa0|"
    assert (
        filled("{-(frame // 2) % 5}", 4) == "3"
        and filled("plain", 1) == "plain"
        and filled("{frame / 2:02d}", 4) == "02"
    )


@pytest.mark.parametrize(
    "text",
    [
        *("{frames}", "{frame.real}", "{__import__('os')}", "{frame / 0}", "{frame:q}", "{frame +}"),
        *("{min(frame, 1, key=print)}", "{max(*frame)}", "{frame:.999999999f}", "{frame:0999999999d}", "{frame:100}"),
    ],
)
def test_text_that_cannot_be_computed_is_refused(text):
    with pytest.raises(NgptError, match="frame"):
        filled(text, 3)


def test_targets_are_patterns_and_folders(tmp_path):
    assert targets(None, "a/box.xml", [3])[3].name == "box.0003.exr"
    folder = tmp_path / "shot"
    assert targets(str(folder), "shot_{frame}.xml", [3]) == {3: folder / "shot.0003.exr"}
    with pytest.raises(NgptError, match="one file for 2 frames"):
        targets(str(tmp_path / "a.exr"), "box", [1, 2])
    with pytest.raises(NgptError, match="would be frame 1 and frame 2"):
        targets("{frame // 9}.exr", "box", [1, 2])
    assert targets(str(tmp_path / "{frame}.png"), "box", [1]) == {1: tmp_path / "1.png"}
    assert targets(str(tmp_path / "a.PNG"), "box", [1]) == {1: tmp_path / "a.PNG"}
    with pytest.raises(NgptError, match=r"one file for 2 frames; write -o '.*a\.\{frame:04d\}\.PNG'"):
        targets(str(tmp_path / "a.PNG"), "box", [1, 2])
    assert not (tmp_path / "a.PNG").exists()


SMALL = "render diffuse --size 16x12 --spp 1 --sampler primal"


def test_a_shot_is_rendered_and_gone_on_with(renderer, command):
    keys = [{"frame": f, "origin": [f / 10, 1.25, 3.9], "target": [0, 1.15, 0]} for f in (0, 2)]
    Path("path.json").write_text(json.dumps({"keys": keys}))
    words, one = f"{SMALL} --camera path.json -o shot --frames", Path("shot/diffuse.0001.exr")
    command(f"{words} 0:2")
    first = one.read_bytes()
    assert "exists already" in command(f"{words} 0:3", 1)
    assert "2 of 3 frames were skipped" in command(f"{words} 0:3 --skip-existing")
    assert one.read_bytes() == first
    one.write_bytes(first[:-5])
    told = command(f"{words} 0:3 --skip-existing")
    assert "2 of 3 frames were skipped" in told and "in place of a file that was not whole" in told
    assert len(one.read_bytes()) == len(first)
    stack = ngpt.read("shot/diffuse.0002.exr")
    assert stack.attributes["ngpt:frame"] == 2 and abs(stack["motion"]).max() > 0.05


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ("render none.xml --frames 0:2 -o made", 1),
        ("render diffuse --frames 0:2 -o made --camera none.json", 1),
        ("render diffuse --frames 0:2 -o made --sampler gvpm", 1),
        ("render diffuse --frames 0:2 -o made/{frame}.exr --size 300x200 --memory 9", 1),
        ("dataset --config data-tiny --out made --variant none", 2),
    ],
)
def test_what_is_refused_prints_a_line_and_leaves_nothing(renderer, command, words, status):
    told = command(words, status)
    assert told.startswith("ngpt: error: ") and told.count("\n") == 1
    assert not Path("made").exists()


@pytest.fixture
def shot(renderer, command):
    """Renders the frames 0, 2 and 4 into a folder; returns the stacks there by name."""

    def render(folder, more=""):
        command(f"{SMALL} --frames 0:6:2 -o {folder} {more}")
        return {file.name: ngpt.read(file) for file in sorted(Path(folder).iterdir())}

    return render


def alike(stack, other):
    same = {name: value for name, value in stack.attributes.items() if name != "ngpt:seconds"}
    assert same.items() <= other.attributes.items()
    assert all(np.array_equal(stack[name], other[name], equal_nan=True) for name in stack.names)


def test_parts_of_a_shot_are_its_frames(shot):
    whole, parts = shot("whole"), [shot(f"part{i}", f"--shard {i}/2") for i in range(2)]
    assert [len(part) for part in parts] == [2, 1] and sorted([*parts[0], *parts[1]]) == list(whole)
    for name, stack in (parts[0] | parts[1]).items():
        alike(stack, whole[name])
    assert whole["diffuse.0004.exr"].attributes["ngpt:previousFrame"] == 2


def test_a_cluster_renders_the_parts_that_are_missing(shot, command, monkeypatch):
    monkeypatch.setattr(shot_files, "cluster", lambda address: jobs.Serial())
    monkeypatch.setattr(shot_files, "FRAMES_OF_A_PART", 1)
    whole, cluster = shot("whole"), "--cluster tcp://nowhere:1 --json"
    assert list(shot("farm", cluster)) == list(whole)
    report = json.loads(command.output)
    assert [frame["frame"] for frame in report["frames"]] == [0, 2, 4] and report["skipped"] == 0
    Path("farm/diffuse.0004.exr").unlink()
    again = shot("farm", f"{cluster} --skip-existing")
    report = json.loads(command.output)
    assert [frame["frame"] for frame in report["frames"]] == [4] and report["skipped"] == 2
    for name, stack in again.items():
        alike(stack, whole[name])


def test_two_pairs_are_rendered(renderer, command):
    command(f"{SMALL} --frames 0:2 --dt 2 -o shot")
    stack = ngpt.read("shot/diffuse.0001.exr")
    assert not stack["dt"].any() and stack["dt_var"].shape == stack["primal"].shape


@pytest.mark.parametrize(
    "line", ["render diffuse --frames 0:2 -o shot/{frame}.exr", "dataset --config data-tiny --out shot"]
)
def test_a_cluster_that_cannot_be_used_is_refused_before_anything_is_shown(
    renderer, command, monkeypatch, tmp_path, line
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr(Console, "progress", lambda *arguments, **how: pytest.fail("work is shown"))
    told = command(f"{line} --cluster tcp://nowhere:1", 1)
    (error,) = told.splitlines()
    assert command.output == "" and "a Dask cluster needs distributed; `" in error
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_interrupts_a_cluster_at_once_and_no_render_that_is_done(renderer, command, monkeypatch):
    before, seen = signal.getsignal(signal.SIGINT), []
    note = lambda *_, **__: seen.append(signal.getsignal(signal.SIGINT)) or shot_files.Written()  # noqa: E731
    monkeypatch.setattr(render, "write_frames_on_cluster", note)
    parser = argparse.ArgumentParser()
    render.add_arguments(parser)
    args = parser.parse_args(["diffuse", "--frames", "0:2", "--cluster", "tcp://nowhere:1", "-o", "shot"])
    assert render.run(args, Console(quiet=True)) == 0 and seen == [before]
    interrupt = Interrupt()
    interrupt.signal = signal.SIGINT
    monkeypatch.setattr(render, "stop_on_ctrl_c", contextmanager(lambda noted: iter([interrupt])))
    command("render diffuse --size 8x8 --sampler primal -o a.exr")
    assert ngpt.read("a.exr").attributes["ngpt:spp"] == 32
    command(f"{SMALL} -o a.exr --force --spp 100000", 130)


@pytest.mark.slow
def test_workers_of_a_real_cluster_render_the_bits_of_one_process(renderer, command):
    distributed = pytest.importorskip("distributed")
    line = "render diffuse --frames 0:17 --size 16x12 --spp 2 --sampler gpt -o"
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        command(f"{line} farm --cluster {cluster.scheduler_address}")
    command(f"{line} alone")
    for frame in range(17):
        ours, theirs = (ngpt.read(f"{folder}/diffuse.{frame:04d}.exr") for folder in ("farm", "alone"))
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs.names)
