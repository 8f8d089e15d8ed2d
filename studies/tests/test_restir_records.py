"""Records of paths: evaluated in their own pixel they give what was recorded, and there and back is where they were."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from restir_shots import SIZE, Candidates, Room, close, inverse, worth

from data_gen.paths.space import Filled
from data_gen.paths.walk import Limits
from data_gen.scenes.builtin import _camera, _diffuse, _sphere, _wall
from ngpt.errors import NgptError
from ngpt_studies.restir.record import STUCK
from ngpt_studies.restir.stage import check


def lamps():
    """Lamps that are sampled otherwise than uniformly by area: a ball, a point, a spot; a sky; and holes."""
    look = mi.ScalarTransform4f().look_at([1, 2, 1], [0, 0, 0], [0, 1, 0])
    hole = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "nested": _diffuse(0.2, 0.6, 0.3)}}
    glow = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": _camera([0, 1.0, 4], [0, 0.5, 0], 45),
        "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.6, 0.5, 0.4)),
        "glow": _sphere([0.9, 0.6, 0], 0.3, _diffuse(0.5, 0.5, 0.5)) | glow,
        "ball": _sphere([-0.5, 0.5, 0], 0.5, {"type": "roughplastic", "alpha": 0.3}),
        "leaf": _wall([0.2, 0.6, 1.0], [0, 0, 1], (0.5, 0.5), hole),
        "point": {"type": "point", "position": [0, 2, 1], "intensity": 1.0},
        "spot": {"type": "spot", "to_world": look, "intensity": 2.0},
        "sky": {"type": "constant", "radiance": 0.2},
    }


@pytest.fixture(scope="module", params=["diffuse", "glossy", "lamps"])
def paths(request, renderer):
    room = Room(lamps() if request.param == "lamps" else request.param)
    room.limits = Limits(6, 3)
    return Candidates(room._stage(room.scene))


def place(record, move):
    """Opaque, lest each move be compiled into a kernel of its own."""
    return mi.Point2f(record.place + mi.Vector2f(*(dr.opaque(mi.Float, m) for m in move)))


def test_a_record_is_worth_in_its_own_pixel_what_was_recorded(paths):
    f, J, _ = worth(paths.stage, paths.record)
    for kind in set(paths.kind[paths.lit]) - {STUCK}:
        here = paths.lit & (paths.kind == kind)
        assert close(f[:, here], paths.f[:, here]) > 0.999, kind
        assert np.abs(J[here] - 1).max() < 1e-4
    assert not f[:, paths.kind == STUCK].any()


@pytest.mark.parametrize("paths", ["glossy"], indirect=True)
def test_all_kinds_of_paths_are_met(paths):
    assert set(paths.kind[paths.lit]) == {0, 1, 2, 3, 4, 5}
    assert np.array(paths.record.replayed)[paths.lit].max() > 2


@pytest.mark.parametrize("move", [(1, 0), (5, 3), (0.3, -0.6)])
def test_there_and_back_is_where_it_was(paths, move):
    there = place(paths.record, move)
    f, J, geometry = worth(paths.stage, paths.record, there)
    exists = paths.lit & f.any(axis=0)
    assert exists.sum() > 500
    moved = paths.record.moved(there, geometry)
    same, unit, _ = worth(paths.stage, moved, place(moved, (0, 0)))
    assert close(same[:, exists], f[:, exists]) > 0.999
    assert np.abs(unit[exists] - 1).max() < 1e-3
    back, J_back, _ = worth(paths.stage, moved, place(moved, [-m for m in move]))
    assert close(back[:, exists], paths.f[:, exists]) > 0.999
    assert inverse(J[exists], J_back[exists]) > 0.999
    # Where paths reconnect there is a Jacobian.
    assert (np.abs(J[exists] - 1) > 1e-3).sum() > 100


def test_beyond_the_film_there_are_no_paths(paths):
    assert not worth(paths.stage, paths.record, place(paths.record, (SIZE, 0)))[0].any()


@pytest.mark.parametrize("option", ["limits", "space"])
def test_what_records_cannot_hold_is_refused(paths, option):
    plan = paths.stage.plan
    check(plan)
    cannot = {"limits": Limits(hide_emitters=True), "space": Filled(paths.stage.scene)}
    with pytest.raises(NgptError, match="restir"):
        check(replace(plan, **{option: cannot[option]}))
