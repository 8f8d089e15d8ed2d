"""Reservoirs over frames of a scene that changes: unbiased after three frames of things and of lamps that move."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from restir_shots import CHAINS, FRAMES, SIZE, layers_of, noise_left, rendered_by_gpt
from unbiased import load

from ngpt.testing import z_test

# Of the camera, to its side, in a frame
PAN = 0.03


def things(mi, params, starts, frame):
    """A ball goes, a box turns and becomes wider: half a pixel and more, and shadows with them."""
    params["ball.to_world"] = mi.Transform4f().translate([-0.06 * frame, 0.03 * frame, 0]) @ starts["ball"]
    angle = np.radians(8 * frame)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    vertices, middle = starts["tall"], starts["tall"].mean(axis=0)
    moved = ((vertices - middle) @ turn.T) * [1 + 0.3 * frame, 1, 1] + middle
    set_vertices(params, moved)


def set_vertices(params, moved):
    from data_gen.scenes.geometry import put_vertices, vertices_name

    put_vertices(params, vertices_name(params, "tall"), moved)


def lamp(mi, params, starts, frame):
    """The lamp goes to the side, and becomes redder and brighter."""
    params["lamp.to_world"] = mi.Transform4f().translate([0.25 * frame, 0, 0.1 * frame]) @ starts["lamp"]
    params["lamp.emitter.radiance.value"] = mi.Color3f(14 * (1 + frame), 12, 9)


CHANGES = {"things": things, "lamp": lamp}


class Room:
    """A built-in scene that changes; the camera moves too. Frames are of two scenes in turn."""

    def __init__(self, mi, name, change, more=None):
        from data_gen.scenes import builtin, geometry

        description = getattr(builtin, name)() | (more or {})
        description["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        self.mi, self.change, self.pan = mi, change, PAN
        self.depths = {key: description["integrator"].get(key, 5) for key in ("max_depth", "rr_depth")}
        self.scenes = [load(mi, description) for _ in range(2)]
        params = mi.traverse(self.scenes[0])
        self.starts = {
            key: mi.Transform4f(params[f"{key}.to_world"])
            for key in ("ball", "lamp", "sensor")
            if f"{key}.to_world" in params
        }
        if name := geometry.vertices_name(params, "tall"):
            self.starts["tall"] = geometry.vertices(params, name)

    def stage(self, frame):
        from data_gen.frames.motion import snapshot
        from data_gen.paths.walk import Limits
        from data_gen.samplers.gpt.plan import make_plan
        from data_gen.samplers.restir.stage import Stage

        scene = self.scenes[frame % 2]
        params = self.mi.traverse(scene)
        self.change(self.mi, params, self.starts, frame)
        params["sensor.to_world"] = self.starts["sensor"] @ self.mi.Transform4f().translate([self.pan * frame, 0, 0])
        params.update()
        plan = make_plan(scene, Limits(**self.depths), caustic=False)
        now = snapshot(scene)
        return Stage(scene, plan, scene.sensors()[0], now.shapes), now

    def frames(self, seed=5, chains=CHAINS, count=FRAMES, **options):
        """History, and for each frame its values, (chains, H, W, 3)."""
        from data_gen.frames.motion import motion_vectors
        from data_gen.samplers.restir.history import History

        history = before = None
        for frame in range(count):
            stage, now = self.stage(frame)
            history = history or History(stage, seed, chains, **options)
            motion = None if before is None else motion_vectors(stage.scene, now, before)
            values, before = history.next_frame(motion, stage=stage), now
            yield history, layers_of(values, chains)


@pytest.fixture(scope="module")
def rooms(renderer):
    return cache(lambda name, change: Room(renderer, name, CHANGES[change]))


@pytest.fixture(scope="module")
def references(rooms):
    """Layers of independent renders of gpt of the last frame, (renders, H, W, 3)."""

    @cache
    def rendered(name, change):
        stage, _ = rooms(name, change).stage(FRAMES - 1)
        return rendered_by_gpt(stage.scene)

    return rendered


@pytest.fixture(scope="module")
def shots(rooms):
    return cache(lambda name, change: [values for _, values in rooms(name, change).frames()])


GLOSSY = pytest.param(("glossy", "lamp"), marks=pytest.mark.slow)
SHOTS = [("diffuse", "lamp"), pytest.param(("diffuse", "things"), marks=pytest.mark.slow), GLOSSY]


@pytest.mark.parametrize("shot", SHOTS)
@pytest.mark.parametrize("name", ["path", "primal", "dx", "dy"])
def test_the_third_frame_of_a_change_is_unbiased(shots, references, shot, name):
    result = z_test(shots(*shot)[-1][name], references(*shot)[name])
    assert result.passed, result


@pytest.mark.parametrize("shot", SHOTS)
@pytest.mark.parametrize("name", ["primal", "dx", "dy"])
def test_history_is_worth_it(shots, shot, name):
    assert noise_left(shots(*shot), name) < 0.8


def found_in(room, frame):
    """A stage, and candidates there."""
    import drjit as dr

    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers.restir import walk

    stage, _ = room.stage(frame)
    camera = CameraSamples(stage.sensor, 3, 16)
    sample = room.mi.UInt32(np.arange(SIZE * SIZE * 16) % 16)
    found = walk.walk(stage, camera, sample, walk.choices(3, camera, sample))
    dr.eval(found)
    return stage, found


def worth(stage, record, place=None):
    """f and J of records at places on the film."""
    import drjit as dr
    import mitsuba as mi

    from data_gen.samplers.restir.evaluate import evaluate_record

    shifted = evaluate_record(stage, 3, record, record.place if place is None else place, mi.Bool(True))
    dr.eval(shifted)
    return np.array(shifted.f), np.array(shifted.J), shifted.geometry


def close(a, b):
    return np.mean(np.abs(a - b).max(axis=0) < 1e-3 * np.maximum(a, b).max(axis=0) + 1e-12)


def stale(room, frame, of):
    """The stage of a frame, in the state of frame ``of``."""
    change, room.change = room.change, lambda mi, params, starts, _: change(mi, params, starts, of)
    stage, _ = room.stage(frame)
    room.change = change
    return stage


@pytest.mark.parametrize("shot", [("diffuse", "lamp"), ("diffuse", "things"), GLOSSY])
def test_carried_to_a_scene_of_the_same_state_a_path_is_the_same(rooms, shot):
    from data_gen.samplers.restir.carry import Carry
    from data_gen.samplers.restir.record import STUCK

    room = rooms(*shot)
    room.pan = 0
    source, found = found_in(room, 1)
    target = stale(room, 0, of=1)
    carried = Carry(source, target)(3, found.record, found.W > 0)
    f, J, _ = worth(target, carried)
    kind, lit = np.array(found.record.kind), np.array(found.W) > 0
    assert {0, 2, 3} <= set(kind[lit])
    for k in set(kind[lit]) - {STUCK}:
        here = lit & (kind == k)
        assert close(f[:, here], np.array(found.f)[:, here]) > 0.995, k
        assert np.abs(J[here] - 1).max() < 1e-3
    room.pan = PAN


@pytest.mark.parametrize("shot", [("diffuse", "lamp"), ("diffuse", "things"), GLOSSY])
def test_carried_there_and_back_a_path_is_what_it_was(rooms, shot):
    """r(T x) r(x) = 1, through a change of the scene and to another pixel."""
    import drjit as dr

    from data_gen.samplers.restir.carry import Carry

    room = rooms(*shot)
    source, found = found_in(room, 0)
    target, _ = room.stage(1)
    place = room.mi.Point2f(found.record.place + room.mi.Vector2f(0.4, -0.3))
    carried = Carry(source, target)(3, found.record, found.W > 0)
    f, J, geometry = worth(target, carried, place)
    exists = (np.array(found.W) > 0) & f.any(axis=0)
    assert exists.sum() > 0.7 * (np.array(found.W) > 0).sum() > 500
    moved = carried.moved(place, geometry)
    dr.eval(moved)
    back, inverse, _ = worth(source, Carry(target, source)(3, moved, found.W > 0), found.record.place)
    assert close(back[:, exists], np.array(found.f)[:, exists]) > 0.99
    assert np.mean(np.abs(J[exists] * inverse[exists] - 1) < 1e-3) > 0.99


def wider(mi, params, starts, frame):
    """All shapes are stretched along x and y, a ball alike everywhere."""
    by = 1 + frame * np.array([1.0, 0.5, 0])
    params["ball.to_world"] = starts["ball"] @ mi.Transform4f().scale(1 + frame)
    params["lamp.to_world"] = starts["lamp"] @ mi.Transform4f().scale([float(v) for v in by])
    set_vertices(params, starts["tall"] * by)


def test_rc_goes_with_its_shape_and_the_measure_with_its_area(renderer):
    from data_gen.samplers.restir.carry import Carry

    room = Room(renderer, "diffuse", wider)
    source, found = found_in(room, 0)
    target, _ = room.stage(1)
    carried = Carry(source, target)(3, found.record, found.W > 0)
    kind, lit = np.array(found.record.kind), np.array(found.W) > 0
    pointer = drjit_ids(found.record.shape)
    stretch = np.array(found.record.geometry / carried.geometry)
    old, new = np.array(found.record.P), np.array(carried.P)
    ids = {
        shape.id(): number
        for shape, number in zip(source.scene.shapes(), drjit_ids(source.scene.shapes_dr()), strict=True)
    }
    on = {name: lit & np.isin(kind, (1, 2, 3)) & (pointer == ids[name]) for name in ("ball", "lamp", "tall", "floor")}
    assert min(where.sum() for where in on.values()) > 3
    middle = np.array(room.starts["ball"].matrix).reshape(4, 4)[:3, 3:]
    assert np.allclose(new[:, on["ball"]] - middle, 2 * (old[:, on["ball"]] - middle), atol=1e-4)
    assert np.allclose(stretch[on["ball"]], 4, rtol=1e-3)
    assert np.allclose(stretch[on["lamp"]], 2 * 1.5, rtol=1e-3)
    assert np.allclose(stretch[on["floor"]], 1, rtol=1e-5)
    assert np.allclose(new[:, on["tall"]], np.diag([2, 1.5, 1]) @ old[:, on["tall"]], atol=1e-4)
    # |det A| |A^-T n|, with the normals of the box
    face = np.array(found.record.primitive)[on["tall"]]
    box = source.shapes[[shape.id() for shape in source.scene.shapes()].index("tall")]
    a, b, c = (box.vertices[box.faces[face, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert np.allclose(stretch[on["tall"]], 3 * np.linalg.norm(n / [2, 1.5, 1], axis=1), rtol=1e-3)


def drjit_ids(shapes):
    import drjit as dr
    import mitsuba as mi

    return np.array(dr.reinterpret_array(mi.UInt32, shapes))


def test_what_was_not_there_is_not_carried(renderer):
    """A mesh of other triangles, and a shape more."""
    from data_gen.samplers.restir.carry import Carry
    from data_gen.samplers.restir.record import STUCK
    from data_gen.scenes.geometry import Mesh

    room = Room(renderer, "diffuse", lambda *args: None)
    source, found = found_in(room, 0)
    target, _ = room.stage(1)
    names = [shape.id() for shape in source.scene.shapes()]
    shapes = list(target.shapes)[:-1]
    assert names[-1] == "ball"
    tall = shapes[names.index("tall")]
    shapes[names.index("tall")] = Mesh(tall.vertices, tall.faces[:-1])
    carried = Carry(source, replace(target, shapes=shapes))(3, found.record, found.W > 0)
    ids = drjit_ids(source.scene.shapes_dr())
    pointer, kind = drjit_ids(found.record.shape), np.array(found.record.kind)
    joined = (np.array(found.W) > 0) & np.isin(kind, (1, 2, 3))
    gone = joined & np.isin(pointer, [ids[names.index(name)] for name in ("tall", "ball")])
    assert gone.sum() > 100
    assert (np.array(carried.kind) == STUCK)[gone].all()
    assert (np.array(carried.kind) == kind)[joined & ~gone].all()


# ------------------------------ Mutants ------------------------------
