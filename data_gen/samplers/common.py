"""What our integrators share as Mitsuba plugins."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass, render_passes
from data_gen.scenes.load import path_depths, reference_integrator
from ngpt.errors import NgptError
from ngpt.layers import LAYERS


class GradientIntegrator(mi.SamplingIntegrator):
    """An integrator that renders the layers of a gradient stack.

    ``render()`` returns a tensor (height, width, channels) whose channels ``aov_names()`` lists, in the order of the
    layers of a stack. The film's reconstruction filter is not used, since a gradient is a difference of box-filtered
    pixels. Derived classes implement ``prepare()`` and ``sample()``.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.channels: list[str] = []

    def prepare(self, scene) -> SamplePass:
        """What takes the samples of a pass."""
        raise NotImplementedError

    def render_film(self, scene, sensor, seed: int, spp: int) -> GradientFilm:
        """The film of ``spp`` samples per pixel."""
        return render_passes(self.prepare(scene), sensor, seed, spp)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Renders all layers: see ``mitsuba.Integrator.render()`` for the parameters."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        spp = spp or sensor.sampler().sample_count()
        layers = self.render_film(scene, sensor, seed, spp).develop()
        self.channels = [f"{name}.{c}" for name in layers for c in LAYERS[name].channels]
        return mi.TensorXf(np.concatenate(list(layers.values()), axis=-1))

    def aov_names(self):
        return self.channels


def like_path(scene: mi.Scene, plugin: str, **options) -> GradientIntegrator:
    """The integrator ``plugin`` with the parameters of the scene's own ``path``, and ``options`` of its own.

    Raises NgptError where the parameters cannot be read.
    """
    path = reference_integrator(scene)
    depths = path_depths(path)
    if not depths:
        raise NgptError(
            f"cannot read max_depth and rr_depth from the integrator, which describes itself as {str(path)!r}; "
            "use --sampler gpt-basic"
        )
    return mi.load_dict({"type": plugin, "hide_emitters": path.hide_emitters, **depths, **options})
