"""Records of paths: evaluated in their own pixel they give what was recorded, and there and back is where they were."""

from dataclasses import replace

import numpy as np
import pytest
from unbiased import load

SIZE, SPP, SEED = 24, 16, 3
MOVES = [(1, 0), (5, 3), (0.3, -0.6)]


def lamps():
    """Lamps that are sampled otherwise than uniformly by area: a ball, a point, a spot; a sky; and holes."""
    import mitsuba as mi

    from data_gen.scenes.builtin import _camera, _diffuse, _sphere, _wall

    look = mi.ScalarTransform4f().look_at([1, 2, 1], [0, 0, 0], [0, 1, 0])
    hole = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "nested": _diffuse(0.2, 0.6, 0.3)}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": _camera([0, 1.0, 4], [0, 0.5, 0], 45),
        "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.6, 0.5, 0.4)),
        "glow": _sphere([0.9, 0.6, 0], 0.3, _diffuse(0.5, 0.5, 0.5))
        | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}}},
        "ball": _sphere([-0.5, 0.5, 0], 0.5, {"type": "roughplastic", "alpha": 0.3}),
        "leaf": _wall([0.2, 0.6, 1.0], [0, 0, 1], (0.5, 0.5), hole),
        "point": {"type": "point", "position": [0, 2, 1], "intensity": 1.0},
        "spot": {"type": "spot", "to_world": look, "intensity": 2.0},
        "sky": {"type": "constant", "radiance": 0.2},
    }


class Paths:
    """Candidates of a scene, and what they are worth elsewhere."""

    def __init__(self, mi, description):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.paths.walk import Limits
        from data_gen.samplers.gpt.plan import make_plan
        from data_gen.samplers.restir import walk
        from data_gen.samplers.restir.stage import Stage

        description["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        self.mi, self.walk = mi, walk
        self.scene = load(mi, description)
        self.sensor = self.scene.sensors()[0]
        self.plan = make_plan(self.scene, Limits(6, 3), caustic=False)
        self.stage = Stage(self.scene, self.plan, self.sensor)
        self.camera = CameraSamples(self.sensor, SEED, SPP)
        self.sample = mi.UInt32(np.arange(SIZE * SIZE * SPP) % SPP)
        choice = walk.choices(SEED, self.camera, self.sample)
        self.found = walk.walk(self.stage, self.camera, self.sample, choice)
        dr.eval(self.found)
        self.f, self.W = np.array(self.found.f), np.array(self.found.W)
        self.kind = np.array(self.found.record.kind)
        self.replayed = np.array(self.found.record.replayed)

    def place(self, record, move):
        """Opaque, lest each move be compiled into a kernel of its own."""
        import drjit as dr

        return self.mi.Point2f(record.place + self.mi.Vector2f(*(dr.opaque(self.mi.Float, m) for m in move)))

    def at(self, record, move):
        """(f, J, geometry) of the records, ``move`` pixels from where they are."""
        import drjit as dr

        from data_gen.samplers.restir.evaluate import evaluate_record

        place = self.place(record, move)
        shifted = evaluate_record(self.stage, SEED, record, place, self.mi.Bool(True))
        dr.eval(shifted)
        return np.array(shifted.f), np.array(shifted.J), shifted.geometry


@pytest.fixture(scope="module", params=["diffuse", "glossy", "lamps"])
def paths(request, renderer):
    from data_gen.scenes import builtin

    return Paths(renderer, lamps() if request.param == "lamps" else getattr(builtin, request.param)())


def close(a, b):
    """The share of paths of equal light: a shadow ray's epsilons make it less than 1."""
    return np.mean(np.abs(a - b).max(axis=0) < 1e-3 * np.maximum(a, b).max(axis=0) + 1e-12)


def test_a_record_takes_80_bytes(renderer):
    from data_gen.samplers.restir.record import empty, record_bytes

    assert record_bytes(empty(3)) == 80


def test_kind_and_depth_share_a_word(renderer):
    from data_gen.samplers.restir.record import MOST_VERTICES, STUCK, empty, word_of

    for kind, replayed, behind, sampled in (
        (STUCK, 0, 9, True),
        (0, MOST_VERTICES, 0, False),
        (3, 7, MOST_VERTICES, True),
    ):
        word = word_of(*(renderer.UInt32(n) for n in (kind, replayed, behind)), renderer.Bool(sampled))
        record = replace(empty(1), word=word)
        found = (record.kind[0], record.replayed[0], record.behind[0], record.sampled[0])
        assert found == (kind, replayed, behind, sampled)


def test_a_record_is_worth_in_its_own_pixel_what_was_recorded(paths):
    from data_gen.samplers.restir.record import STUCK

    f, J, _ = paths.at(paths.found.record, (0, 0))
    lit = paths.W > 0
    for kind in set(paths.kind[lit]) - {STUCK}:
        here = lit & (paths.kind == kind)
        assert close(f[:, here], paths.f[:, here]) > 0.999, kind
        assert np.abs(J[here] - 1).max() < 1e-4
    assert not f[:, paths.kind == STUCK].any()


@pytest.mark.parametrize("paths", ["glossy"], indirect=True)
def test_all_kinds_of_paths_are_met(paths):
    assert set(paths.kind[paths.W > 0]) == {0, 1, 2, 3, 4, 5}
    assert paths.replayed[paths.W > 0].max() > 2


@pytest.mark.parametrize("move", MOVES)
def test_there_and_back_is_where_it_was(paths, move):
    record = paths.found.record
    f, J, geometry = paths.at(record, move)
    exists = (paths.W > 0) & f.any(axis=0)
    assert exists.sum() > 500
    moved = record.moved(paths.place(record, move), geometry)
    there, unit, _ = paths.at(moved, (0, 0))
    assert close(there[:, exists], f[:, exists]) > 0.999
    assert np.abs(unit[exists] - 1).max() < 1e-3
    back, inverse, _ = paths.at(moved, [-m for m in move])
    assert close(back[:, exists], paths.f[:, exists]) > 0.999
    assert np.mean(np.abs(J[exists] * inverse[exists] - 1) < 1e-3) > 0.999
    # Where paths reconnect there is a Jacobian.
    assert (np.abs(J[exists] - 1) > 1e-3).sum() > 100


@pytest.mark.parametrize("move", [(1, 0), (5, 3)])
def test_a_walk_from_there_would_reconnect_at_the_same_vertex(paths, move):
    """What has been replayed must be replayed by the reverse shift: no vertex of it may be joined."""
    f, _, _ = paths.at(paths.found.record, move)
    camera = paths.camera
    camera_there = Displaced(camera, move)
    choice = paths.walk.choices(SEED, camera, paths.sample)
    other = paths.walk.walk(paths.stage, camera_there, paths.sample, choice)
    kind, replayed = np.array(other.record.kind), np.array(other.record.replayed)
    # Of the kinds that tell where the walk from there has its rc
    tells = (np.array(other.W) > 0) & np.isin(kind, (1, 2, 3, 5)) & (paths.W > 0) & f.any(axis=0)
    assert tells.sum() > 100
    assert (replayed >= paths.replayed)[tells].all()


class Displaced:
    """The camera samples of ``camera``, ``move`` pixels from where they are."""

    def __init__(self, camera, move):
        self.pixel, self.random, self._rays = camera.pixel, camera.random, lambda: camera.rays(move)
        self.position = camera.position

    def rays(self):
        return self._rays()


def test_what_cannot_be_seen_from_there_is_not_there(paths):
    """Beyond the film there are no paths."""
    f, _, _ = paths.at(paths.found.record, (SIZE, 0))
    assert not f.any()


def test_geometry_makes_the_jacobian_of_a_reconnection(renderer, rng):
    from data_gen.paths.shift import reconnection_jacobian
    from data_gen.samplers.restir.record import geometry_of

    mi = renderer
    x, y, target, normal = (rng.normal(size=(3, 64)).astype(np.float32) for _ in range(4))
    normal /= np.linalg.norm(normal, axis=0)
    J = reconnection_jacobian(mi.Point3f(x), mi.Point3f(y), mi.Point3f(target), mi.Normal3f(normal))
    after, before = (geometry_of(mi.Normal3f(normal), mi.Point3f(target), mi.Point3f(p)) for p in (y, x))
    assert np.allclose(np.array(after / before), np.array(J), rtol=1e-3)


@pytest.mark.parametrize("option", ["limits", "space"])
def test_what_records_cannot_hold_is_refused(paths, option):
    from data_gen.paths.space import Filled
    from data_gen.paths.walk import Limits
    from data_gen.samplers.restir.stage import check
    from ngpt.errors import NgptError

    check(paths.plan)
    cannot = {"limits": Limits(hide_emitters=True), "space": Filled(paths.scene)}
    with pytest.raises(NgptError, match="restir"):
        check(replace(paths.plan, **{option: cannot[option]}))
