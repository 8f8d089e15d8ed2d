"""Records of paths: evaluated in their own pixel they give what was recorded, and there and back is where they were."""

from dataclasses import fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from restir_shots import SIZE, Candidates, Room, close, inverse, worth

from data_gen.paths.shift import reconnection_jacobian
from data_gen.paths.space import Filled
from data_gen.paths.walk import Limits
from data_gen.scenes.builtin import _camera, _diffuse, _sphere, _wall
from ngpt.errors import NgptError
from ngpt_studies.restir.record import MOST_VERTICES, STUCK, empty, geometry_of, word_of
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


def test_kind_and_depth_share_a_word_and_a_record_takes_80_bytes(renderer):
    for kind, *numbers in (
        (STUCK, 0, 9, True),
        (0, MOST_VERTICES, 0, False),
        (3, 7, MOST_VERTICES, True),
    ):
        replayed, behind, sampled = numbers
        word = word_of(*(mi.UInt32(n) for n in (kind, replayed, behind)), mi.Bool(sampled))
        record = replace(empty(1), word=word)
        assert [v[0] for v in (record.kind, record.replayed, record.behind, record.sampled)] == [kind, *numbers]

    def words(value):
        return sum(map(words, value)) if dr.depth_v(value) > 1 else 1

    record = empty(3)
    assert 4 * sum(words(getattr(record, f.name)) for f in fields(record)) == 80


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


class Displaced:
    """The camera samples of ``camera``, ``move`` pixels from where they are."""

    def __init__(self, camera, move):
        self.pixel, self.random, self.position = camera.pixel, camera.random, camera.position
        self.rays = lambda: camera.rays(move)


@pytest.mark.parametrize("move", [(1, 0), (5, 3)])
def test_a_walk_from_there_would_reconnect_at_the_same_vertex(paths, move):
    """What has been replayed must be replayed by the reverse shift: no vertex of it may be joined."""
    f, _, _ = worth(paths.stage, paths.record, place(paths.record, move))
    other = paths.walk(Displaced(paths.camera, move))
    # Of the kinds that tell where the walk from there has its rc
    tells = (np.array(other.W) > 0) & np.isin(np.array(other.record.kind), (1, 2, 3, 5)) & paths.lit & f.any(axis=0)
    assert tells.sum() > 100
    assert (np.array(other.record.replayed) >= np.array(paths.record.replayed))[tells].all()


def test_beyond_the_film_there_are_no_paths(paths):
    assert not worth(paths.stage, paths.record, place(paths.record, (SIZE, 0)))[0].any()


def test_geometry_makes_the_jacobian_of_a_reconnection(renderer, rng):
    x, y, target, normal = (rng.normal(size=(3, 64)).astype(np.float32) for _ in range(4))
    n, at = mi.Normal3f(normal / np.linalg.norm(normal, axis=0)), mi.Point3f(target)
    J = reconnection_jacobian(mi.Point3f(x), mi.Point3f(y), at, n)
    assert np.allclose(np.array(geometry_of(n, at, mi.Point3f(y)) / geometry_of(n, at, mi.Point3f(x))), J, rtol=1e-3)


@pytest.mark.parametrize("option", ["limits", "space"])
def test_what_records_cannot_hold_is_refused(paths, option):
    plan = paths.stage.plan
    check(plan)
    cannot = {"limits": Limits(hide_emitters=True), "space": Filled(paths.stage.scene)}
    with pytest.raises(NgptError, match="restir"):
        check(replace(plan, **{option: cannot[option]}))
