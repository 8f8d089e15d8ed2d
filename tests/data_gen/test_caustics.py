"""How much light mirrors and glass make of lamps without size: a look says so, and `--for auto` takes photons then."""

import logging

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.caustics import share_of_caustics
from data_gen.choosing import plans
from data_gen.choosing.trials import Pilot
from data_gen.render import render_stack
from data_gen.request import RenderRequest
from data_gen.scenes.builtin import _camera, _diffuse, _sphere, _wall


def burning_glass(mi, ball="dielectric", lamp=None, film=(48, 36)):
    """A floor, seen from below a ball that a lamp shines through; the ball is out of sight."""
    # Of a size that paths meet
    beside = _sphere([1.5, 1, 1], 0.2, _diffuse(0.5, 0.5, 0.5)) | {"emitter": {"type": "area", "radiance": 2.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": _camera([0, 0.35, 1.2], [0, 0, 0], 45),
        "floor": _wall([0, 0, 0], [0, 1, 0], (4, 4), _diffuse(0.5, 0.5, 0.5)),
        "ball": _sphere([0, 1.3, 0], 0.5, {"type": ball}),
        "beside": beside,
        "lamp": lamp or {"type": "point", "position": [0, 3, 0], "intensity": 5.0},
    }
    return load(mi, scene, film)


def test_the_look_finds_what_paths_do_not(renderer):
    """The light that paths from both ends find and Mitsuba's ``path`` does not."""
    scene = burning_glass(renderer)
    whole = render_stack(scene, 64, 1, "bdpt")["primal"].mean()
    seen = np.array(renderer.render(scene, spp=64, seed=2)).mean()
    share = share_of_caustics(scene)
    assert 0.1 < share < 0.9 and share == pytest.approx(1 - seen / whole, rel=0.05)
    assert share == share_of_caustics(scene)
    assert tuple(scene.sensors()[0].film().size()) == (48, 36)


def test_lamps_that_paths_meet_do_not_count(renderer):
    lamp = {"type": "sphere", "center": [0, 3, 0], "radius": 0.3, "emitter": {"type": "area", "radiance": 9.0}}
    assert share_of_caustics(burning_glass(renderer, lamp=lamp)) == 0
    assert share_of_caustics(burning_glass(renderer, "diffuse")) == 0
    tiny = lamp | {"radius": 0.001, "emitter": {"type": "area", "radiance": 8e5}}
    assert share_of_caustics(burning_glass(renderer, lamp=tiny)) > 0.1


def planned(scene, seconds, method="auto", **more):
    return plans.plan(scene, RenderRequest(scene, seconds=seconds, method=method), **more)


def test_a_plan_takes_photons_where_there_is_time(renderer):
    scene = burning_glass(renderer)
    plan = planned(scene, 60.0, pilot=Pilot(lambda: 0.0))
    assert (plan.sampler, plan.method) == ("vcm", "oidn") and 20 < plan.render < 60
    assert "of the light is caustics of lamps" in plan.reason
    # Too short, too large, a method that cannot use them, and nothing to find
    assert planned(scene, 5.0).sampler == "primal"
    assert planned(burning_glass(renderer, film=(1920, 1080)), 60.0).sampler == "primal"
    assert planned(scene, 60.0, "ngpt-combine").sampler == "gpt"
    assert planned(burning_glass(renderer, "diffuse"), 60.0).sampler == "primal"
    assert planned(scene, 60.0, pilot=Pilot(stop=lambda: True)).sampler == "primal"


def test_a_look_that_takes_all_of_the_time_leaves_some_for_the_render(renderer, monkeypatch):
    monkeypatch.setattr("data_gen.caustics.share_of_caustics", lambda scene: 0.5)
    clock = iter((0.0, 100.0))
    plan = planned(burning_glass(renderer), 60.0, pilot=Pilot(lambda: next(clock)))
    assert plan.sampler == "vcm" and 0 < plan.render < 1


def test_how_much_is_said(renderer, caplog):
    from data_gen.inspect import warn_of_lost_light

    scene = burning_glass(renderer)
    with caplog.at_level(logging.WARNING):
        warn_of_lost_light(scene, "primal")
    percent = f"{share_of_caustics(scene):.0%}"
    assert "'primal' hardly finds the caustics of " in caplog.text
    assert f", about {percent} of the light on what the camera sees directly; " in caplog.text
