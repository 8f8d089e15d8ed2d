"""``ngpt advise``: by a pilot of this scene, for a time or an error."""

import json
import time
from functools import partial
from itertools import count
from pathlib import Path

import pytest

import ngpt

pytest.importorskip("mitsuba")

from data_gen.choosing import pipelines, plans, trials
from data_gen.choosing.pipelines import Pipeline, usual_fall
from data_gen.choosing.trials import Pilot
from data_gen.scenes.load import load_scene


@pytest.fixture
def seen(renderer, monkeypatch):
    """A scene in which samples of two samplers leave known errors."""
    usual = {m: usual_fall("gpt", m) for m in ("wcv", "primal", "l1")}
    found = [
        Pipeline("primal", "primal", 16, 0.02, usual["primal"], 0.001, 0.0),
        Pipeline("gpt", "wcv", 16, 0.01, usual["wcv"], 0.002, 0.01),
        Pipeline("gpt", "wcv", 16, 0.01, usual["wcv"], 0.002, 0.01, adaptive=0.5, choosing=0.001),
        Pipeline("gpt", "l1", 16, 0.05, usual["l1"], 0.002, 0.01),
    ]
    monkeypatch.setattr(plans, "explore", lambda scene, seconds, **options: found)
    return found


@pytest.fixture
def advice(command):
    """The rows of ``ngpt advise`` for a goal."""

    def rows(goal):
        command(f"advise diffuse --size 32x24 --json -q {goal}")
        return json.loads(command.output)["advice"]

    return rows


def test_the_least_error_in_a_time(seen, advice):
    rows = advice("--seconds 0.1")
    assert [(r["sampler"], r["method"], r["adaptive"]) for r in rows] == [
        ("primal", "primal", False),
        ("gpt", "wcv", False),
        ("gpt", "l1", False),
    ]
    assert rows[0]["spp"] in (99, 100) and rows[0]["error"] == pytest.approx(0.02 * 16 / 100, rel=0.02)
    assert all(row["seconds"] <= 0.1 + 1e-9 for row in rows)
    best = advice("--seconds 1")[0]
    assert (best["sampler"], best["method"], best["adaptive"]) == ("gpt", "wcv", True)


def test_the_pilot_takes_no_longer_than_the_time_it_advises_on(renderer, advice, monkeypatch):
    asked = []

    def explore(scene, seconds, **options):
        asked.append(seconds * plans.SHARE)
        assert options["patient"]
        return [Pipeline("primal", "primal", 16, 0.02, -1.0, 0.001, 0.0)]

    monkeypatch.setattr(plans, "explore", explore)
    # One pilot each, however slow the machine is.
    for goal in ("--seconds 1", "--seconds 40", "--seconds 900", "--error 0.01"):
        advice(goal)
    # Kernels take some seconds whatever is to be advised on.
    assert asked == pytest.approx([10, 40, 60, 60])


def test_on_a_busy_machine_one_sampler_is_tried_and_no_more(renderer, monkeypatch):
    """Every look at the clock is a second late: nothing fits, and the first trial ends all the same."""
    scene, seconds = load_scene("diffuse", (16, 12)), count()
    monkeypatch.setattr(plans, "candidates", lambda scene, **_: ["gpt", "bdpt"])
    (found,) = plans.explore(scene, 30.0, pilot=Pilot(lambda: float(next(seconds))), patient=True)
    assert found.sampler == "gpt"
    assert plans.explore(scene, 30.0, pilot=Pilot(lambda: float(next(seconds)))) == []


def test_the_least_time_to_an_error(seen, advice, command):
    rows = advice("--error 0.001")
    assert all(row["error"] <= 0.001 * (1 + 1e-9) for row in rows)
    assert [row["seconds"] for row in rows] == sorted(row["seconds"] for row in rows)
    assert rows[0]["adaptive"] and rows[0]["spp"] < rows[-1]["spp"]
    for wrong, message in (("--seconds 1e-9", "nothing fits into"), ("--error 1e-12", "no method reaches")):
        assert message in command(f"advise diffuse --size 32x24 {wrong}", 1)


def test_the_commands_of_a_pilot_run_as_printed(seen, command):
    Path("my scene").mkdir()
    Path("my scene/a box.xml").write_text(BOX)
    command("advise 'my scene/a box.xml' --size 16x12 --seconds 0.4 -D light=3 -q")
    render, denoise = (line for line in command.output.splitlines() if line.startswith("ngpt "))
    for line in (render, denoise):
        command(line.removeprefix("ngpt "))
    (stack,) = Path().glob("a box-*spp.exr")
    assert "samples" in ngpt.read(stack) and "--adaptive" in render
    (result,) = Path().glob("a box-*-wcv.exr")
    assert ngpt.read(result).attributes["ngpt:method"] == "wcv"


def test_a_pilot_advises(renderer, advice, monkeypatch):
    """Whatever it may be: a row for each method of each sampler that was tried."""
    monkeypatch.setattr(plans, "candidates", lambda scene, **_: ["gpt", "primal"])
    monkeypatch.setattr(pipelines, "WITH_GRADIENTS", ("wcv", "l1"))
    monkeypatch.setattr(pipelines, "WITHOUT", ("primal",))
    # By a clock that a busy machine does not hurry, and of no more samples than a render may have
    monkeypatch.setattr(trials, "Pilot", partial(Pilot, lambda: time.perf_counter() / 100))
    rows = advice("--seconds 1")
    assert {(row["sampler"], row["method"]) for row in rows} == {("gpt", "wcv"), ("gpt", "l1"), ("primal", "primal")}
    assert all(row["error"] > 0 and row["spp"] > 100 for row in rows)


BOX = """
<scene version="3.0.0">
    <default name="light" value="1"/>
    <integrator type="path"/>
    <sensor type="perspective"><film type="hdrfilm"/></sensor>
    <shape type="sphere"><point name="center" x="0" y="0" z="4"/></shape>
    <emitter type="constant"><spectrum name="radiance" value="$light"/></emitter>
</scene>
"""
