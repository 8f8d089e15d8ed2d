"""The operations of heads other than +, -, * and /: on tensors of PyTorch, and as nodes of an ONNX graph.

``Tensors`` and ``Nodes`` have the same methods, so that a head is written once for both. Images are (N, C, H, W); an
``axis`` is ``X`` or ``Y``. For a list of images, there is one weight, or the logarithm of a weight, for each image.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from ngpt.network import transfer

# Axes of (N, C, H, W).
X, Y = 3, 2
# The end of a slice that goes to the end of its axis.
_END = 2**63 - 1
# The logarithm of the weight of pixels beyond the border.
_NEVER = -1e9


class Tensors:
    """The operations on tensors."""

    exp, tanh, sigmoid, inverse = torch.exp, torch.tanh, torch.sigmoid, torch.reciprocal
    signed_log, signed_exp = transfer.signed_log, transfer.signed_exp

    @staticmethod
    def part(x: Tensor, first: int, last: int) -> Tensor:
        """Channels first .. last - 1."""
        return x[:, first:last]

    @staticmethod
    def mean(x: Tensor) -> Tensor:
        """The mean over channels, (N, 1, H, W)."""
        return x.mean(1, keepdim=True)

    @staticmethod
    def halved(x: Tensor) -> Tensor:
        """Means over 2 x 2 pixels."""
        return avg_pool2d(x, 2)

    @staticmethod
    def doubled(x: Tensor) -> Tensor:
        """The image at twice its size, by bilinear interpolation."""
        return interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)

    @staticmethod
    def every_other(x: Tensor, first: int, axis: int) -> Tensor:
        """Every second pixel along an axis, from the pixel ``first`` on."""
        return x[..., first::2] if axis == X else x[..., first::2, :]

    @staticmethod
    def before(x: Tensor, axis: int) -> Tensor:
        """The value of the previous pixel along an axis; 0 for the first pixel."""
        return pad(x[..., :-1], (1, 0)) if axis == X else pad(x[..., :-1, :], (0, 0, 1, 0))

    @staticmethod
    def after(x: Tensor, axis: int) -> Tensor:
        """The value of the next pixel along an axis; 0 for the last pixel."""
        return pad(x[..., 1:], (0, 1)) if axis == X else pad(x[..., 1:, :], (0, 0, 0, 1))

    @staticmethod
    def inside(x: Tensor, axis: int) -> Tensor:
        """The image with 0 in the last pixel along an axis."""
        return pad(x[..., :-1], (0, 1)) if axis == X else pad(x[..., :-1, :], (0, 0, 0, 1))

    @staticmethod
    def where_positive(x: Tensor, then: Tensor, otherwise: float) -> Tensor:
        return torch.where(x > 0, then, otherwise)

    @staticmethod
    def mixed(logits: Tensor, images: list[Tensor]) -> Tensor:
        """The mean of images, weighted in each pixel by the softmax of ``logits`` (N, images, H, W)."""
        weights = torch.softmax(logits, 1)
        return torch.stack([weights[:, i : i + 1] * image for i, image in enumerate(images)]).sum(0)

    @staticmethod
    def filtered(logits: Tensor, image: Tensor, weight: Tensor, size: int) -> Tensor:
        """Weighted means over size x size pixels of an image.

        The weight of a pixel is exp(``logits``) at its tap (its place in the window), (N, size², H, W), times the
        pixel's own ``weight`` (N, 1, H, W). Taps are in row-major order. Pixels beyond the border have no weight.
        """
        height, width = image.shape[-2:]
        border = 4 * (size // 2,)
        image, trust = pad(image, border), pad(torch.log(weight), border, value=_NEVER)
        places = [(y, x) for y in range(size) for x in range(size)]
        kernels = logits + torch.cat([trust[..., y : y + height, x : x + width] for y, x in places], 1)
        return averaged(torch.softmax(kernels, 1), image, size)


def averaged(kernels: Tensor, image: Tensor, size: int) -> Tensor:
    """Sums of ``size`` x ``size`` pixels, weighted by ``kernels`` (N, size², H, W), whose taps are in row-major order.

    The image (N, C, H + size - 1, W + size - 1) has size // 2 more pixels on every side.
    """
    height, width = kernels.shape[-2:]
    total = torch.zeros_like(image[..., :height, :width])
    # Taps are added one after the other, because all at once would take the memory of size² images. ``unbind`` is used,
    # because the gradient of each slice would be a tensor of the size of all kernels.
    for tap, kernel in enumerate(kernels.unbind(1)):
        y, x = divmod(tap, size)
        total = total + kernel[:, None] * image[..., y : y + height, x : x + width]
    return total


class Nodes:
    """The operations as nodes of a graph.

    ``op`` has ONNX's operators by name, and ``signed_log`` and ``signed_exp``.
    """

    def __init__(self, op: Any):
        self._op = op
        self.exp, self.tanh, self.sigmoid, self.inverse = op.Exp, op.Tanh, op.Sigmoid, op.Reciprocal
        self.signed_log, self.signed_exp = op.signed_log, op.signed_exp

    def part(self, x: Any, first: int, last: int) -> Any:
        return self._op.Slice(x, [first], [last], [1])

    def mean(self, x: Any) -> Any:
        return self._op.ReduceMean(x, [1], keepdims=1)

    def halved(self, x: Any) -> Any:
        return self._op.AveragePool(x, kernel_shape=[2, 2], strides=[2, 2])

    def doubled(self, x: Any) -> Any:
        sizes = np.array([1, 1, 2, 2], np.float32)
        return self._op.Resize(x, None, sizes, mode="linear", coordinate_transformation_mode="half_pixel")

    def every_other(self, x: Any, first: int, axis: int) -> Any:
        return self._op.Slice(x, [first], [_END], [axis], [2])

    def before(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [0], [-1], [axis]), [1, 0], 0.0, [axis])

    def after(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [1], [_END], [axis]), [0, 1], 0.0, [axis])

    def inside(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [0], [-1], [axis]), [0, 1], 0.0, [axis])

    def where_positive(self, x: Any, then: Any, otherwise: float) -> Any:
        return self._op.Where(self._op.Greater(x, 0.0), then, otherwise)

    def mixed(self, logits: Any, images: list[Any]) -> Any:
        # ONNX Runtime's own softmax works only over the last axis, so it would transpose all channels before and after.
        weights = self._op.Exp(logits - self._op.ReduceMax(logits, [1], keepdims=1))
        total = 0.0
        for i, image in enumerate(images):
            total = self.part(weights, i, i + 1) * image + total
        return total / self._op.ReduceSum(weights, [1], keepdims=1)

    def filtered(self, logits: Any, image: Any, weight: Any, size: int) -> Any:
        border = [size // 2] * 4
        trust, pixels = (
            self._shifted(self._op.Pad(x, border, value, [2, 3]), size)
            for x, value in ((self._op.Log(weight), _NEVER), (image, 0.0))
        )
        return self.mixed(logits + self._op.Concat(*trust, axis=1), pixels)

    def _shifted(self, image: Any, size: int) -> list[Any]:
        """For each tap, in row-major order, the pixels (N, C, H, W) that it reads; H and W are without the border."""
        # The size of the image is unknown here, so slices end relative to its end. The last slice ends beyond any size.
        ends = [n - size + 1 if n < size - 1 else 2**62 for n in range(size)]
        return [self._op.Slice(image, [y, x], [ends[y], ends[x]], [2, 3]) for y in range(size) for x in range(size)]
