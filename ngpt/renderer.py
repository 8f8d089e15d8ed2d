"""The interface of a renderer for the evaluation, ``ngpt info`` and ``ngpt train``.

An entry point of the group "ngpt.renderers" names the installed renderer, ``data_gen.service``, and
``ngpt.system.parts.find_renderer`` returns it. Nothing in ngpt imports the renderer directly.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from ngpt.stack import GradientStack

# The options of a render: the name of its sampler, the options of the sampler, whether features are rendered, subpixels
Options = Mapping[str, Any]


class Renderer(Protocol):
    """All functions raise NgptError for scenes and samplers that do not exist or cannot be combined."""

    def load(self, source: str, size: tuple[int, int]) -> Any:
        """A scene from a file, or a built-in one, for images of ``size`` (width, height) in pixels."""

    def render(
        self, scene: Any, options: Options, spp: int | None, seed: int, *, seconds: float | None
    ) -> GradientStack:
        """A stack of ``spp`` samples per pixel, or of as many as ``seconds`` allow."""

    def warm_up(self, scene: Any, options: Options) -> GradientStack:
        """Compiles the kernels of a render, and returns a stack of one sample per pixel."""

    def timed(self, scene: Any, options: Options, spp: int, seed: int, clock: str) -> tuple[GradientStack, float]:
        """A stack, and the seconds of its render by the ``clock`` "wall" or "processor"."""

    def measure(
        self, scene: Any, renders: Mapping[str, Options], spp: int, repeats: int, *, clock: str
    ) -> tuple[dict[str, list[float]], GradientStack]:
        """The seconds per sample of each of the named ``renders``, and the last stack of the first of these renders."""

    def batch(self, sampler: str) -> int:
        """The number of samples per pixel in a group of dependent samples; 0 if all samples are independent."""

    def gradients(self, sampler: str) -> bool:
        """Whether the sampler renders gradients; True for an unknown one."""

    def unusual(self, sampler: str, options: Options) -> str:
        """The options of the sampler, and ``subpixels``, that are not defaults: "radius=1, photons=2, subpixels=2".

        Raises NgptError for wrong options.
        """

    def code(self, sampler: str) -> str:
        """A hash of the code that runs in a render by this sampler, which may be "auto"."""

    def scene_code(self, name: str) -> str:
        """A hash of a built-in scene."""

    def overview(self) -> dict[str, Any]:
        """Samplers and built-in scenes, for ``ngpt info``."""

    def describe_sampler(self, name: str) -> dict[str, Any]:
        """The description of a sampler; an empty dictionary if no sampler has that name."""

    def inspect(self, name: str, parameters: dict[str, str]) -> dict[str, Any]:
        """The contents of a scene, and how it would be rendered."""


class Crops(Protocol):
    """The function that renders crops for ``ngpt train``, such as ``data_gen.dataset.stream.stream``.

    ``ngpt.system.parts.find_crops`` finds it by an entry point of the group "ngpt.crops".
    """

    def __call__(self, config: Path, kept: str = "") -> AbstractContextManager[Any]:
        """The crops of a data set's configuration, which another process renders during the training.

        ``kept``  folder in which references are kept; "": all references are made anew
        """
