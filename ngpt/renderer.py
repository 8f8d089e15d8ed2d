"""The interface of a renderer for the evaluation, ``ngpt info`` and ``ngpt train``.

``ngpt.system.parts.find_renderer`` finds the one that is installed, ``data_gen.service``: an entry point of the group
"ngpt.renderers" names it. Nothing in ngpt imports it.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from ngpt.stack import GradientStack

# The options of a render: its sampler's name, the sampler's own options, whether features are rendered, and subpixels
Options = Mapping[str, Any]


class Renderer(Protocol):
    """All functions raise NgptError for scenes and samplers that do not exist or cannot be combined."""

    def load(self, source: str, size: tuple[int, int]) -> Any:
        """A scene from a file, or a built-in one, for images of ``size`` (width, height) in pixels."""

    def render(
        self, scene: Any, options: Options, spp: int | None, seed: int, *, seconds: float | None
    ) -> GradientStack:
        """A stack of ``spp`` samples per pixel, or of those that fit into ``seconds``."""

    def warm_up(self, scene: Any, options: Options) -> GradientStack:
        """Compiles the kernels of a render; returns its stack of one sample."""

    def timed(self, scene: Any, options: Options, spp: int, seed: int, clock: str) -> tuple[GradientStack, float]:
        """A stack and its seconds, by the ``clock`` "wall" or "processor"."""

    def measure(
        self, scene: Any, renders: Mapping[str, Options], spp: int, repeats: int, *, clock: str
    ) -> tuple[dict[str, list[float]], GradientStack]:
        """Seconds per sample of each of the ``renders`` by name, and the last stack of the first of them."""

    def batch(self, sampler: str) -> int:
        """The number of samples per pixel that depend on each other; 0 if all are independent."""

    def gradients(self, sampler: str) -> bool:
        """Whether the sampler renders gradients; True for an unknown one."""

    def unusual(self, sampler: str, options: Options) -> str:
        """The sampler's options, and ``subpixels``, that are not defaults: "radius=1, photons=2, subpixels=2".

        Raises NgptError for wrong ones.
        """

    def code(self, sampler: str) -> str:
        """A hash of the code that a render by the sampler runs; "auto" is a sampler too."""

    def scene_code(self, name: str) -> str:
        """A hash of a built-in scene."""

    def overview(self) -> dict[str, Any]:
        """Samplers and built-in scenes, for ``ngpt info``."""

    def describe_sampler(self, name: str) -> dict[str, Any]:
        """The registry's description of a sampler; empty if no sampler has that name."""

    def inspect(self, name: str, parameters: dict[str, str]) -> dict[str, Any]:
        """The contents of a scene, and how it would be rendered."""


class Crops(Protocol):
    """The function that renders crops for ``ngpt train``. ``ngpt.system.parts.find_crops`` finds it by an entry point
    of the group "ngpt.crops"; ours is ``data_gen.dataset.stream.stream``."""

    def __call__(self, config: Path, kept: str = "") -> AbstractContextManager[Any]:
        """Crops of a dataset's configuration, rendered in another process while they are trained on.

        ``kept``  folder for its references, which are made once; "" always makes new ones
        """
