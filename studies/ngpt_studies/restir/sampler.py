"""The sampler ``restir``: makes a film for each frame of a shot."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import lanes_within, recording
from data_gen.paths.features import features
from data_gen.paths.lights import emission_seen
from data_gen.paths.walk import Limits
from data_gen.samplers.gpt.plan import make_plan
from data_gen.scenes.geometry import Geometry
from data_gen.scenes.load import reference_integrator
from ngpt_studies.restir.history import Frame, History
from ngpt_studies.restir.stage import Stage

# Bytes of a lane: five reservoirs of 100 bytes, five of the frame before, and the evaluations of the requested paths
LANE_BYTES = 3072


class Restir:
    """Renders frames one after the other, with ``spp`` independent chains for each pixel.

    ``history``    the largest confidence of a reservoir, in frames
    ``gradients``  "pairs": pairs of pixels have reservoirs of their own; "after": gradients come from the paths that
                   the pixels' reservoirs have kept, the paper's baseline
    ``roughness_threshold``  as for ``gpt``

    Raises NgptError for scenes that it cannot render.
    """

    def __init__(
        self,
        scene: mi.Scene,
        seed: int,
        spp: int,
        memory: int,
        *,
        history: float,
        gradients: str,
        roughness_threshold: float,
    ):
        self.spp, self._roughness = spp, roughness_threshold
        self.stage = self._stage(scene, ())
        film = self._film()
        lanes_within(memory, film, film.pixels * spp, LANE_BYTES)
        self._remembers = seed, spp, history, gradients == "pairs"
        self._history = self._new()

    def _new(self) -> History:
        return History(self.stage, *self._remembers)

    def _stage(self, scene: mi.Scene, shapes: Sequence[Geometry]) -> Stage:
        plan = make_plan(scene, Limits.of(reference_integrator(scene)), self._roughness, caustic=False)
        return Stage(scene, plan, scene.sensors()[0], shapes)

    def film(
        self,
        index: int,
        motion: np.ndarray | None,
        depth: np.ndarray | None,
        changed: tuple[mi.Scene, Sequence[Geometry]] | None = None,
    ) -> GradientFilm:
        """Renders frame number ``index`` of the shot. If it does not follow the last one, history starts again.

        ``motion`` and ``depth`` are as for ``History.next_frame``. ``changed`` is the scene of this frame with the
        geometry of its shapes, or None if only the camera has moved. This scene must be another object than the scene
        of the frame before, which must not have changed since.
        """
        stage = None if changed is None else self._stage(*changed)
        self.stage = stage or self.stage
        if index != self._history.frames:
            self._history = self._new()
            self._history.frames = index
        frame = self._history.next_frame(motion, depth, stage)
        film = self._film()
        with recording():
            self._put(film, frame)
            film.end_pass(self.spp)
        return film

    @property
    def confidence(self) -> float:
        """Mean confidence of the pixels' reservoirs, in frames."""
        return float(self._history.confidence[0].mean())

    def _film(self) -> GradientFilm:
        return GradientFilm(*(int(n) for n in self.stage.sensor.film().crop_size()))

    def _put(self, film: GradientFilm, frame: Frame) -> None:
        camera = frame.camera
        ray, importance, _ = camera.rays()
        integrator = reference_integrator(self.stage.scene)
        direct = importance * emission_seen(self.stage.scene, integrator, None, ray, mi.Bool(True))
        film.put("primal", mi.Color3f(frame.primal + direct))
        film.put("direct", mi.Color3f(direct))
        for name in ("dx", "dy"):
            # The film takes the mean of both directions of a difference. Here a single value stands for both.
            film.put(f"{name}+", mi.Color3f(2 * getattr(frame, name)))
            film.put(f"{name}-", mi.Color3f(0 * frame.primal))
        film.put_all(features(self.stage.scene, self.stage.sensor, camera.random.clone(), ray))


make = Restir
