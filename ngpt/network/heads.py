"""Heads: from what a network predicts to the logarithm of the image. They hold no weights; the last convolution does.

    Direct     the prediction is the logarithm [Kettunen et al. 2019]
    Residual   it corrects the logarithm of the image the network starts from
    Mixture    a weight for each of several images, and a correction of the logarithm of their mean
    Kernels    weights for the k x k pixels around, in all of the images: their mean, nothing added [Bako et al. 2017,
               "Kernel-predicting convolutional networks", section 4.2; for several images Vogels et al. 2018]

Each has the number of channels it asks of the network, the computation in PyTorch, and the same as an ONNX graph.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from ngpt.network.transfer import signed_log


@dataclass(frozen=True)
class Head(ABC):
    """What all heads have.

    ``start``    the images it reads, in order; names of ``ngpt.network.features.IMAGES``
    ``outputs``  channels of the prediction
    ``radius``   how far around a pixel it reads the images
    ``neutral``  whether a prediction of 0 is a sensible image, so that training begins there
    """

    start: tuple[str, ...] = ()
    neutral: ClassVar[bool] = True

    @property
    def radius(self) -> int:
        return 0

    @property
    @abstractmethod
    def outputs(self) -> int: ...

    @abstractmethod
    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        """The signed log of the image, (N, 3, H, W) float32.

        ``prediction`` (N, outputs, H, W) float32. ``images`` are those of ``start``, with ``radius`` more pixels on
        every side: (N, 3, H + 2 radius, W + 2 radius), scene-linear, over the exposure.
        """

    @abstractmethod
    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        """``forward`` as nodes of an ONNX graph: ``op`` has the operators of ONNX by name, and ``signed_log``."""


class Direct(Head):
    """The logarithm itself."""

    neutral = False

    @property
    def outputs(self) -> int:
        return 3

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        return prediction

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        return prediction


class Residual(Head):
    """A correction of the logarithm of one image."""

    @property
    def outputs(self) -> int:
        return 3

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        return prediction + signed_log(images[0])

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        return prediction + op.signed_log(images[0])


class Mixture(Head):
    """In each pixel a weight for each image (softmax), and a correction of the logarithm of their mean."""

    @property
    def outputs(self) -> int:
        return 3 + len(self.start)

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        weights = torch.softmax(prediction[:, 3:], 1)
        mean = torch.stack([weights[:, i : i + 1] * image for i, image in enumerate(images)]).sum(0)
        return prediction[:, :3] + signed_log(mean)

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        weights = op.Softmax(op.Slice(prediction, [3], [self.outputs], [1]), axis=1)
        mean = op.Sum(*(op.Slice(weights, [i], [i + 1], [1]) * image for i, image in enumerate(images)))
        return op.Slice(prediction, [0], [3], [1]) + op.signed_log(mean)


@dataclass(frozen=True)
class Kernels(Head):
    """In each pixel a weight (softmax) for each of ``size`` x ``size`` pixels around it, in each image.

    The result lies between the least and the largest of these pixels: it can neither invent a colour nor add light.
    """

    size: int = 3

    @property
    def radius(self) -> int:
        return self.size // 2

    @property
    def outputs(self) -> int:
        return len(self.start) * self.size**2

    @property
    def _taps(self) -> list[tuple[int, int, int]]:
        """(image, row, column) of each channel of the prediction."""
        side = range(self.size)
        return [(i, y, x) for i in range(len(self.start)) for y in side for x in side]

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        height, width = prediction.shape[-2:]
        weights = torch.softmax(prediction, 1)
        mean = torch.zeros_like(images[0][..., :height, :width])
        # One tap after the other: all of them at once would be size² images.
        for tap, (i, y, x) in enumerate(self._taps):
            mean = mean + weights[:, tap : tap + 1] * images[i][..., y : y + height, x : x + width]
        return signed_log(mean)

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        weights = op.Softmax(prediction, axis=1)
        mean = 0.0
        for tap, (i, y, x) in enumerate(self._taps):
            # Ends count from the end, as the size is not known here; the last pixel's is beyond any.
            ends = [n - 2 * self.radius if n < 2 * self.radius else 2**62 for n in (y, x)]
            mean = op.Slice(weights, [tap], [tap + 1], [1]) * op.Slice(images[i], [y, x], ends, [2, 3]) + mean
        return op.signed_log(mean)


def head_of(start: tuple[str, ...], kernel: int) -> Head:
    """The head of a network that starts from these images, by kernels of that size or (0) pixel by pixel."""
    if kernel:
        return Kernels(start, kernel)
    if not start:
        return Direct()
    return Residual(start) if len(start) == 1 else Mixture(start)
