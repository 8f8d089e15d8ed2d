"""Records carried into a scene in which things and lamps have moved; frames of such shots: ``test_restir_history``."""

from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from restir_shots import SEED, Candidates, Room, close, inverse, lamp, set_vertices, things, worth

from data_gen.scenes.geometry import Triangles
from ngpt_studies.restir.carry import Carry
from ngpt_studies.restir.record import STUCK


@pytest.fixture(scope="module")
def rooms(renderer):
    return cache(Room)


def carried(source, target, candidates, record=None):
    return Carry(source, target)(SEED, record or candidates.record, candidates.found.W > 0)


def drjit_ids(shapes):
    return np.array(dr.reinterpret_array(mi.UInt32, shapes))


def ids(scene):
    return dict(zip([shape.id() for shape in scene.shapes()], drjit_ids(scene.shapes_dr()), strict=True))


SHOTS = [("diffuse", lamp), ("diffuse", things), pytest.param(("glossy", lamp), marks=pytest.mark.slow)]


@pytest.mark.parametrize("shot", SHOTS)
def test_carried_to_a_scene_of_the_same_state_a_path_is_the_same(rooms, shot, monkeypatch):
    room = rooms(*shot)
    monkeypatch.setattr(room, "step", 0)
    source, _ = room.at(1)
    found = Candidates(source)
    target, _ = room.at(0, state=1)
    f, J, _ = worth(target, carried(source, target, found))
    assert {0, 2, 3} <= set(found.kind[found.lit])
    for kind in set(found.kind[found.lit]) - {STUCK}:
        here = found.lit & (found.kind == kind)
        assert close(f[:, here], found.f[:, here]) > 0.995, kind
        assert np.abs(J[here] - 1).max() < 1e-3


@pytest.mark.parametrize("shot", SHOTS)
def test_carried_there_and_back_a_path_is_what_it_was(rooms, shot):
    """r(T x) r(x) = 1, through a change of the scene and to another pixel."""
    room = rooms(*shot)
    source, _ = room.at(0)
    found = Candidates(source)
    target, _ = room.at(1)
    place = mi.Point2f(found.record.place + mi.Vector2f(0.4, -0.3))
    there = carried(source, target, found)
    f, J, geometry = worth(target, there, place)
    exists = found.lit & f.any(axis=0)
    assert exists.sum() > 0.7 * found.lit.sum() > 500
    moved = there.moved(place, geometry)
    dr.eval(moved)
    back, J_back, _ = worth(source, carried(target, source, found, moved), found.record.place)
    assert close(back[:, exists], found.f[:, exists]) > 0.99
    assert inverse(J[exists], J_back[exists]) > 0.99


def wider(params, starts, frame):
    """All shapes are stretched along x and y, a ball alike everywhere."""
    by = 1 + frame * np.array([1.0, 0.5, 0])
    params["ball.to_world"] = starts["ball"] @ mi.Transform4f().scale(1 + frame)
    params["lamp.to_world"] = starts["lamp"] @ mi.Transform4f().scale([float(v) for v in by])
    set_vertices(params, starts["tall"] * by)


def test_rc_goes_with_its_shape_and_the_measure_with_its_area(rooms):
    room = rooms("diffuse", wider)
    source, _ = room.at(0)
    found = Candidates(source)
    target, _ = room.at(1)
    there = carried(source, target, found)
    stretch = np.array(found.record.geometry / there.geometry)
    old, new = np.array(found.record.P), np.array(there.P)
    joined = found.lit & np.isin(found.kind, (1, 2, 3))
    on = {name: joined & (drjit_ids(found.record.shape) == number) for name, number in ids(source.scene).items()}
    assert min(on[name].sum() for name in ("ball", "lamp", "tall", "floor")) > 3
    middle = np.array(room.starts["ball"].matrix).reshape(4, 4)[:3, 3:]
    assert np.allclose(new[:, on["ball"]] - middle, 2 * (old[:, on["ball"]] - middle), atol=1e-4)
    assert np.allclose(stretch[on["ball"]], 4, rtol=1e-3)
    assert np.allclose(stretch[on["lamp"]], 2 * 1.5, rtol=1e-3)
    assert np.allclose(stretch[on["floor"]], 1, rtol=1e-5)
    assert np.allclose(new[:, on["tall"]], np.diag([2, 1.5, 1]) @ old[:, on["tall"]], atol=1e-4)
    # |det A| |A^-T n|, with the normals of the box
    box = source.shapes[list(on).index("tall")]
    a, b, c = (box.vertices[box.faces[np.array(found.record.primitive)[on["tall"]], i]] for i in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert np.allclose(stretch[on["tall"]], 3 * np.linalg.norm(n / [2, 1.5, 1], axis=1), rtol=1e-3)


def test_what_was_not_there_is_not_carried(rooms):
    """A mesh of other triangles, and a shape more."""
    room = rooms("diffuse", lambda *args: None)
    source, _ = room.at(0)
    found = Candidates(source)
    target, _ = room.at(1)
    numbers = ids(source.scene)
    names, shapes = list(numbers), list(target.shapes)[:-1]
    assert names[-1] == "ball"
    tall = shapes[names.index("tall")]
    shapes[names.index("tall")] = Triangles(tall.vertices, tall.faces[:-1])
    there = carried(source, replace(target, shapes=shapes), found)
    joined = found.lit & np.isin(found.kind, (1, 2, 3))
    gone = joined & np.isin(drjit_ids(found.record.shape), [numbers["tall"], numbers["ball"]])
    assert gone.sum() > 100
    kind = np.array(there.kind)
    assert (kind[gone] == STUCK).all() and (kind == found.kind)[joined & ~gone].all()
