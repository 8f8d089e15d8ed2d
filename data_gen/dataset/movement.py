"""Random movements in the shots (frame sequences) of a training set.

In each shot the camera may move, one thing may move, and the light may change. Every speed is constant in a shot, and
log-uniform over shots.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.dataset.cameras import CameraView, Surroundings, floats
from data_gen.frames.motion import seen
from data_gen.scenes.geometry import VERTICES, put_vertices, vertices

# Shares of the shots in which the camera moves, a thing moves, and the light changes. If the light changes, no thing
# moves and a lamp can be moved, then a lamp moves with probability LAMP. In all other cases of a changing light, a
# radiance changes.
CAMERA, THING, LIGHT, LAMP = 0.8, 0.35, 0.35, 0.5
# Movement per frame at the median distance, as a share of the image's width: 0.1 to 9.6 of 96 pixels.
SPEEDS = 0.001, 0.1
# A moving thing must fill this share of the pixels: smaller things are hardly seen, larger ones are walls.
SIZES = 0.01, 0.3
# Changes per frame: of the lamp's position, relative to the median distance, and of the logarithm of its radiance
LAMP_WAYS, GAINS = (0.005, 0.08), (0.01, 0.3)
# The most that a camera moves over all frames, as a share of the distance to the next obstacle
CLEAR = 0.6
RADIANCE = (".radiance.value", ".intensity.value", ".irradiance.value")


@dataclass
class Movement:
    """The changes from frame to frame. If only ``view`` is set, nothing changes."""

    view: CameraView
    way: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the camera, in world units per frame
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of its target, in addition to ``way``
    shape: str = ""  # the parameter that places the moving shape
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the movement of that shape per frame
    light: str = ""  # the parameter with the radiance of the changing light
    gain: float = 1.0  # the factor of that radiance per frame
    _start: dict = field(default_factory=dict, repr=False)

    def view_at(self, frame: int) -> CameraView:
        origin = np.add(self.view.origin, frame * np.array(self.way))
        target = np.add(self.view.target, frame * (np.array(self.way) + self.turn))
        return replace(self.view, origin=floats(origin), target=floats(target))

    def apply(self, scene: mi.Scene, frame: int) -> None:
        """Sets ``scene`` to the state of a frame. Frame 0 is the original scene, seen by the view."""
        self.view_at(frame).apply(scene)
        if not self.shape and not self.light:
            return
        params = mi.traverse(scene)
        far = np.array(self.shift) * frame
        if self.shape.endswith(".to_world"):
            start = self._start.setdefault(self.shape, mi.Transform4f(params[self.shape]))
            params[self.shape] = mi.Transform4f(mi.ScalarTransform4f().translate(list(map(float, far)))) @ start
        elif self.shape:
            put_vertices(params, self.shape, self._start.setdefault(self.shape, vertices(params, self.shape)) + far)
        if self.light:
            start = self._start.setdefault(self.light, type(params[self.light])(params[self.light]))
            value = start * self.gain**frame
            dr.make_opaque(value)  # as a literal it would be compiled into the kernels
            params[self.light] = value
        params.update()

    def record(self) -> dict:
        facts = {"way": self.way, "turn": self.turn, "shape": self.shape, "shift": self.shift}
        return facts | {"light": self.light, "gain": self.gain}


def random_movement(around: Surroundings, view: CameraView, rng: np.random.Generator, frames: int) -> Movement:
    """A random movement for a shot of ``frames`` frames that starts at ``view``. Also applies ``view`` to the scene."""
    scene = around.scene
    view.apply(scene)
    what = seen(scene)
    shapes = what.shape[what.shape >= 0]
    eye, target = np.array(view.origin), np.array(view.target)
    hits = what.points[what.shape >= 0, :3] - eye
    distance = float(np.median(np.linalg.norm(hits, axis=1))) if len(hits) else around.scale
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, view.up)
    right /= max(np.linalg.norm(right), 1e-9)
    axes = np.stack([right, np.cross(right, forward), forward])
    # The width of the visible part of the scene at that distance
    width = 2 * distance * np.tan(np.radians(view.fov) / 2) * view.size / view.film[0]

    def speed(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    made = Movement(view)
    if rng.random() < CAMERA:
        # Movement along the view direction changes the image less than sideways movement.
        way = rng.normal(size=3) * (1, 0.5, 2) @ axes
        way *= speed(*SPEEDS) * width / np.linalg.norm(way)
        free = float(around.cast(eye[None], (way / np.linalg.norm(way))[None])[0][0])
        way *= min(1.0, CLEAR * free / (frames * float(np.linalg.norm(way))))
        turn = rng.normal(size=2) * (1, 0.5) @ axes[:2]
        turn *= rng.integers(2) * speed(*SPEEDS) * width / max(np.linalg.norm(turn), 1e-9)
        turn *= np.linalg.norm(target - eye) / distance
        made.way, made.turn = floats(way), floats(turn)
    movable = _movable(scene)
    if rng.random() < THING:
        share = np.bincount(shapes, minlength=len(scene.shapes())) / len(what.shape)
        things = [i for i in movable if SIZES[0] < share[i] < SIZES[1]]
        if things:
            way = rng.normal(size=3) @ axes
            made.shape = movable[things[int(rng.integers(len(things)))]]
            made.shift = floats(way * speed(*SPEEDS) * width / np.linalg.norm(way))
    if rng.random() < LIGHT:
        lamps = [i for i in movable if scene.shapes()[i].is_emitter()]
        lights = sorted(name for name in mi.traverse(scene).keys() if name.endswith(RADIANCE))  # noqa: SIM118
        if lamps and not made.shape and rng.random() < LAMP:
            way = rng.normal(size=3)
            made.shape = movable[lamps[int(rng.integers(len(lamps)))]]
            made.shift = floats(way * speed(*LAMP_WAYS) * around.scale / np.linalg.norm(way))
        elif lights:
            made.light = lights[int(rng.integers(len(lights)))]
            made.gain = float(np.exp(rng.choice([-1, 1]) * speed(*GAINS)))
    return made


def _movable(scene: mi.Scene) -> dict[int, str]:
    """For each shape that can be moved, by its number: the name of the parameter that places the shape."""
    places: dict[int, str] = {}
    numbers = {shape: number for number, shape in enumerate(scene.shapes())}
    # Shapes are recognised by their nodes and not by their names, since shapes may have no name
    for name, (_, _, node, _) in mi.traverse(scene).properties.items():
        kind = name.rpartition(".")[2]
        if node in numbers and (kind == "to_world" or (kind in VERTICES and numbers[node] not in places)):
            places[numbers[node]] = name
    return places
