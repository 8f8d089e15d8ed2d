"""What tests of ``restir`` share: rooms that change from frame to frame, candidates in them, and images of lanes."""

import drjit as dr
import mitsuba as mi
import numpy as np
from unbiased import load

from data_gen.frames.motion import motion_vectors, snapshot
from data_gen.paths.camera import CameraSamples
from data_gen.paths.walk import Limits
from data_gen.render import render_stack
from data_gen.samplers.gpt.plan import make_plan
from data_gen.scenes import builtin, geometry
from ngpt_studies.restir import walk
from ngpt_studies.restir.evaluate import evaluate_record
from ngpt_studies.restir.history import History
from ngpt_studies.restir.stage import Stage

SIZE, CHAINS, FRAMES, SEED = 24, 48, 3, 3


def things(params, starts, frame):
    """A ball goes, a box turns and becomes wider: half a pixel and more, and shadows with them."""
    params["ball.to_world"] = mi.Transform4f().translate([-0.06 * frame, 0.03 * frame, 0]) @ starts["ball"]
    angle = np.radians(8 * frame)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    vertices, middle = starts["tall"], starts["tall"].mean(axis=0)
    set_vertices(params, ((vertices - middle) @ turn.T) * [1 + 0.3 * frame, 1, 1] + middle)


def lamp(params, starts, frame):
    """The lamp goes to the side, and becomes redder and brighter."""
    params["lamp.to_world"] = mi.Transform4f().translate([0.25 * frame, 0, 0.1 * frame]) @ starts["lamp"]
    params["lamp.emitter.radiance.value"] = mi.Color3f(14 * (1 + frame), 12, 9)


def set_vertices(params, moved):
    geometry.put_vertices(params, geometry.vertices_name(params, "tall"), moved)


class Room:
    """A built-in scene whose camera moves; with a ``change`` things or lamps too, and frames are of two scenes in turn.

    Alone, the camera turns and goes sideways by 1.6 pixels in a frame; beside a change by less.
    """

    def __init__(self, name, change=None):
        description = getattr(builtin, name)() if isinstance(name, str) else name
        description["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        self.change, (self.turn, self.step) = change, (0, 0.03) if change else (1, -0.12)
        self.limits = Limits(**{key: description["integrator"].get(key, 5) for key in ("max_depth", "rr_depth")})
        self.scenes = [load(mi, description) for _ in range(2 if change else 1)]
        self.scene, self.sensor = self.scenes[0], self.scenes[0].sensors()[0]
        params = mi.traverse(self.scene)
        shapes = [key for key in ("ball", "lamp", "sensor") if f"{key}.to_world" in params]
        self.starts = {key: mi.Transform4f(params[f"{key}.to_world"]) for key in shapes}
        if vertices := geometry.vertices_name(params, "tall"):
            self.starts["tall"] = geometry.vertices(params, vertices)
        self.still = None if change else self._stage(self.scene)

    def _stage(self, scene, shapes=()):
        return Stage(scene, make_plan(scene, self.limits, caustic=False), scene.sensors()[0], shapes)

    def at(self, frame, state=None):
        """The stage of that frame, and what motion needs of it; things and lamps as in frame ``state``."""
        scene = self.scenes[frame % len(self.scenes)]
        params = mi.traverse(scene)
        if self.change:
            self.change(params, self.starts, frame if state is None else state)
        moved = mi.Transform4f().translate([self.step * frame, 0, 0]).rotate([0, 1, 0], self.turn * frame)
        params["sensor.to_world"] = self.starts["sensor"] @ moved
        params.update()
        now = snapshot(scene)
        return self.still or self._stage(scene, now.shapes), now

    def frames(self, seed=5, chains=CHAINS, count=FRAMES, **options):
        """History, and for each frame its layers, (chains, H, W, 3)."""
        history = before = None
        for frame in range(count):
            stage, now = self.at(frame)
            history = history or History(stage, seed, chains, **options)
            motion = None if before is None else motion_vectors(stage.scene, now, before)
            values, before = history.next_frame(motion, stage=stage if self.change else None), now
            yield history, {name: images(getattr(values, name), chains) for name in ("path", "primal", "dx", "dy")}


def images(values, chains):
    """(chains, H, W, 3) of a value of each lane."""
    return np.moveaxis(np.array(values, np.float64).T.reshape(SIZE, SIZE, chains, 3), 2, 0)


def rendered_by_gpt(scene):
    """The same layers of independent renders of gpt, (renders, H, W, 3)."""
    stacks = [render_stack(scene, 48, seed, "gpt", caustic=False, unbiased=True).layers for seed in range(900, 908)]
    layers = {name: np.stack([stack[name] for stack in stacks]) for name in ("primal", "direct", "dx", "dy")}
    layers["primal"] = layers["path"] = layers["primal"] - layers.pop("direct")
    return layers


class Candidates:
    """Candidates of a stage as they were found, and what their paths are worth elsewhere."""

    def __init__(self, stage, spp=16):
        self.stage, self.camera = stage, CameraSamples(stage.sensor, SEED, spp)
        self.sample = mi.UInt32(np.arange(SIZE * SIZE * spp) % spp)
        self.found = self.walk(self.camera)
        self.record, self.f, self.W = self.found.record, np.array(self.found.f), np.array(self.found.W)
        self.kind, self.lit = np.array(self.record.kind), self.W > 0

    def walk(self, camera):
        found = walk.walk(self.stage, camera, self.sample, walk.choices(SEED, self.camera, self.sample))
        dr.eval(found)
        return found


def worth(stage, record, place=None):
    """f, J and geometry of records at places on the film, or where they are."""
    shifted = evaluate_record(stage, SEED, record, record.place if place is None else place, mi.Bool(True))
    dr.eval(shifted)
    return np.array(shifted.f), np.array(shifted.J), shifted.geometry


def close(a, b):
    """The share of paths of equal light: a shadow ray's epsilons make it less than 1."""
    return np.mean(np.abs(a - b).max(axis=0) < 1e-3 * np.maximum(a, b).max(axis=0) + 1e-12)


def inverse(a, b):
    """The share of products that are 1."""
    return np.mean(np.abs(a * b - 1) < 1e-3)
