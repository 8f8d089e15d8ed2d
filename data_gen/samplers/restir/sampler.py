"""The sampler ``restir``: a film of each frame of a shot whose camera moves."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import lanes_within, recording
from data_gen.paths.features import features
from data_gen.paths.lights import emission_seen
from data_gen.paths.vertex import ROUGHNESS_THRESHOLD
from data_gen.samplers.gpt.plan import make_plan
from data_gen.samplers.restir.history import Frame, History
from data_gen.scenes.load import path_depths, reference_integrator
from ngpt.errors import NgptError

# What a lane takes: five reservoirs of 100 bytes, those of the frame before, and E of what they ask for.
LANE_BYTES = 3072


class Restir:
    """Frames one after the other, of ``spp`` chains for each pixel that know nothing of each other.

    Options: ``history``, the frames that a reservoir can count for; ``gradients``, "pairs": of reservoirs of pairs of
    pixels, or "after": of the paths that the pixels' reservoirs have kept, the paper's baseline; and
    ``roughness_threshold``, as for ``gpt``. Raises NgptError for what cannot be rendered.
    """

    def __init__(
        self,
        scene: mi.Scene,
        seed: int,
        spp: int,
        memory: int,
        history: float = 32,
        gradients: str = "pairs",
        roughness_threshold: float = ROUGHNESS_THRESHOLD,
    ):
        if history < 1:
            raise NgptError(f"restir: a history of {history:g} frames; give 1 or more")
        if gradients not in ("pairs", "after"):
            raise NgptError(f"restir: unknown gradients '{gradients}'; choose pairs or after")
        self.scene, self.sensor, self.spp = scene, scene.sensors()[0], spp
        self.path = reference_integrator(scene)
        depths = path_depths(self.path)
        if not depths:
            raise NgptError(f"restir: cannot read max_depth and rr_depth from the integrator {str(self.path)!r}")
        limit = depths["max_depth"] if depths["max_depth"] >= 0 else 0xFFFFFFFF
        plan = make_plan(
            scene, roughness_threshold, limit, depths["rr_depth"], "replay", self.path.hide_emitters, caustic=False
        )
        film = self._film()
        lanes_within(memory, film, film.pixels * spp, LANE_BYTES)
        self._new = lambda: History(scene, plan, self.sensor, seed, spp, history, gradients == "pairs")
        self._history = self._new()

    def film(self, index: int, motion: np.ndarray | None, depth: np.ndarray | None) -> GradientFilm:
        """Frame number ``index`` of the shot; where it is not the one after the last, history begins anew.

        ``motion`` and ``depth`` are those of ``History.next_frame``.
        """
        if index != self._history.frames:
            self._history = self._new()
            self._history.frames = index
        frame = self._history.next_frame(motion, depth)
        film = self._film()
        with recording():
            self._put(film, frame)
            film.end_pass(self.spp)
        return film

    @property
    def confidence(self) -> float:
        """The frames that reservoirs of pixels count for, the mean over pixels."""
        return float(self._history.confidence[0].mean())

    def _film(self) -> GradientFilm:
        return GradientFilm(*(int(n) for n in self.sensor.film().crop_size()))

    def _put(self, film: GradientFilm, frame: Frame) -> None:
        camera = frame.camera
        ray, importance, _ = camera.rays()
        direct = importance * emission_seen(self.scene, self.path, None, ray, mi.Bool(True))
        film.put("primal", mi.Color3f(frame.primal + direct))
        film.put("direct", mi.Color3f(direct))
        for name in ("dx", "dy"):
            # The film takes the mean of both directions of a difference. Here there is one for both.
            film.put(f"{name}+", mi.Color3f(2 * getattr(frame, name)))
            film.put(f"{name}-", mi.Color3f(0 * frame.primal))
        film.put_all(features(self.scene, self.sensor, camera.random.clone(), ray))


def make(scene: mi.Scene, seed: int, spp: int, memory: int, **options) -> Restir:
    return Restir(scene, seed, spp, memory, **options)
