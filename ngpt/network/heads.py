"""Heads: from a network's prediction to the logarithm of the image. They hold no weights.

    Direct     the prediction is the logarithm [Kettunen et al. 2019]
    Residual   it corrects the logarithm of the image the network starts from
    Mixture    a weight for each of several images, and a correction of the logarithm of their mean
    Pyramid     kernels at several resolutions, of one image, blended from coarse to fine [Vogels et al. 2018,
               "Denoising with kernel prediction and asymmetric loss functions", section 4.3]

Each defines the number of channels of the prediction, the computation in PyTorch, and the same as an ONNX graph.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from ngpt.network.transfer import signed_log

# For ``Pyramid``: the least trust of a pixel; the logarithm of the trust of pixels beyond the border.
LEAST_TRUST, NEVER = 1e-4, -1e9


@dataclass(frozen=True)
class Head(ABC):
    """The interface of all heads.

    ``start``    the images it reads, in order; names of ``ngpt.network.features.IMAGES``
    ``outputs``  channels of the prediction
    ``reads``    the layers that ``forward`` gets: the images, and the other layers that the head reads
    ``radius``   pixels on every side by which these layers must be larger than the prediction
    ``reach``    the distance, in pixels, up to which images and prediction influence the result of a pixel
    ``neutral``  whether a prediction of 0 is a sensible image, so that training begins there
    ``normalise``  whether the input of the last convolution is divided by its root mean square in each pixel. Softmax
                 does not limit features and logits: they would grow until nothing is learnt
    """

    start: tuple[str, ...] = ()
    neutral: ClassVar[bool] = True
    normalise: ClassVar[bool] = False

    @property
    def reads(self) -> tuple[str, ...]:
        return self.start

    @property
    def radius(self) -> int:
        return 0

    @property
    def reach(self) -> int:
        return self.radius

    @property
    @abstractmethod
    def outputs(self) -> int: ...

    @abstractmethod
    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        """The signed log of the image, (N, 3, H, W) float32.

        ``prediction`` (N, outputs, H, W) float32. ``images`` are those it ``reads``, with ``radius`` more pixels on
        every side: (N, 3, H + 2 radius, W + 2 radius), scene-linear, over the exposure.
        """

    @abstractmethod
    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        """``forward`` as nodes of an ONNX graph: ``op`` has the operators of ONNX by name, and ``signed_log``."""


class Direct(Head):
    """The prediction is the logarithm."""

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
        return prediction[:, :3] + signed_log(mixed(torch.softmax(prediction[:, 3:], 1), images))

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        weights, total = _softmax(op, op.Slice(prediction, [3], [self.outputs], [1]))
        return op.Slice(prediction, [0], [3], [1]) + op.signed_log(_mixed(op, weights, images) / total)


@dataclass(frozen=True)
class Pyramid(Head):
    """Kernels of ``size`` x ``size`` pixels at ``scales`` resolutions of one image, each half as fine as the last.

    If there are several images, D is their mean, with a weight for each in each pixel (softmax). w in (0, 1) is the
    trust in each pixel of D; D_s and w_s are both averaged over 2^s x 2^s pixels:

        I_s(p) = sum of k_s(p, q) w_s(q) D_s(q) / sum of k_s(p, q) w_s(q)       q in the kernel around p
        o_s    = I_s + a_s up(o_(s+1) - down(I_s)),  the coarsest o_s = I_s     a_s in (0, 1)

    o_0 is the result. A low trust removes a pixel that a rare bright path has hit from all neighbours, at every
    resolution [as in Gharbi et al. 2019, "Sample-based Monte Carlo denoising using a kernel-splatting network"]. Trust
    is divided by 1 + D, so that such pixels do not dominate the start of training. The predictions of k_s and a_s are
    averaged over the pixels of the resolution.

    ``demodulate``  the kernels average the image divided by the reflectance, and the result is multiplied by it again,
                    so texture is not averaged. A pixel is then weighted by its reflectance, as in a least-squares fit
                    of the image by the reflectance. Otherwise a lamp, whose albedo is 0, would spread ten times its
                    light
    """

    normalise = True

    size: int = 5
    scales: int = 4
    demodulate: bool = False

    @property
    def reads(self) -> tuple[str, ...]:
        return (*self.start, "reflectance") if self.demodulate else self.start

    @property
    def reach(self) -> int:
        # The kernel, the pixels that are averaged, and those that bilinear interpolation reads, at the coarsest scale.
        return sum((self.size // 2 + 2) << scale for scale in range(self.scales))

    @property
    def outputs(self) -> int:
        # Trust; for each scale a kernel, and for each but the coarsest a share; the weights of several images.
        return self.scales * (self.size**2 + 1) + self._weights

    @property
    def _weights(self) -> int:
        return len(self.start) if len(self.start) > 1 else 0

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        image = images[0]
        if self._weights:
            image = mixed(torch.softmax(prediction[:, -self._weights :], 1), images[: self._weights])
        weight = (torch.sigmoid(prediction[:, :1]) + LEAST_TRUST) / (1 + image.abs().mean(1, keepdim=True))
        if self.demodulate:
            image = image / images[-1]
            weight = weight * images[-1].mean(1, keepdim=True)
        rest, taps = prediction[:, 1:], self.size**2
        filtered, shares = [], []
        for scale in range(self.scales):
            if scale:
                light, weight = avg_pool2d(image * weight, 2), avg_pool2d(weight, 2)
                image, rest = light / weight, avg_pool2d(rest[:, taps + 1 :], 2)
            filtered.append(self._filtered(rest[:, :taps], image, weight))
            if scale + 1 < self.scales:
                shares.append(torch.sigmoid(rest[:, taps : taps + 1]))
        result = filtered.pop()
        for fine, share in zip(reversed(filtered), reversed(shares), strict=True):
            change = result - avg_pool2d(fine, 2)
            result = fine + share * interpolate(change, scale_factor=2.0, mode="bilinear", align_corners=False)
        return signed_log(result * images[-1] if self.demodulate else result)

    def _filtered(self, logits: Tensor, image: Tensor, weight: Tensor) -> Tensor:
        """The means of an image (N, C, H, W) by kernels exp ``logits`` times the weights of its pixels."""
        height, width = image.shape[-2:]
        border = 4 * (self.size // 2,)
        image, trust = pad(image, border), pad(torch.log(weight), border, value=NEVER)
        places = [(y, x) for y in range(self.size) for x in range(self.size)]
        kernels = torch.softmax(
            logits + torch.cat([trust[..., y : y + height, x : x + width] for y, x in places], 1), 1
        )
        return averaged(kernels, image, self.size)

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        def part(x: Any, first: int, last: int) -> Any:
            return op.Slice(x, [first], [last], [1])

        def halved(x: Any) -> Any:
            return op.AveragePool(x, kernel_shape=[2, 2], strides=[2, 2])

        image = images[0]
        if self._weights:
            logits = part(prediction, self.outputs - self._weights, self.outputs)
            weights, total = _softmax(op, logits)
            image = _mixed(op, weights, images[: self._weights]) / total
        weight = (op.Sigmoid(part(prediction, 0, 1)) + LEAST_TRUST) / (op.ReduceMean(abs(image), [1], keepdims=1) + 1.0)
        if self.demodulate:
            image = image / images[-1]
            weight = weight * op.ReduceMean(images[-1], [1], keepdims=1)
        rest, taps, border = part(prediction, 1, self.outputs), self.size**2, [self.size // 2] * 4
        filtered, shares = [], []
        for scale in range(self.scales):
            if scale:
                light, weight = halved(image * weight), halved(weight)
                image, rest = light / weight, halved(part(rest, taps + 1, self.outputs))
            trust = _shifted(op, op.Pad(op.Log(weight), border, NEVER, [2, 3]), self.size)
            kernels, total = _softmax(op, part(rest, 0, taps) + op.Concat(*trust, axis=1))
            pixels = _shifted(op, op.Pad(image, border, 0.0, [2, 3]), self.size)
            filtered.append(_mixed(op, kernels, pixels) / total)
            if scale + 1 < self.scales:
                shares.append(op.Sigmoid(part(rest, taps, taps + 1)))
        result = filtered.pop()
        doubled = np.array([1, 1, 2, 2], np.float32)
        for fine, share in zip(reversed(filtered), reversed(shares), strict=True):
            change = result - halved(fine)
            result = fine + share * op.Resize(
                change, None, doubled, mode="linear", coordinate_transformation_mode="half_pixel"
            )
        return op.signed_log(result * images[-1] if self.demodulate else result)


def averaged(kernels: Tensor, image: Tensor, size: int) -> Tensor:
    """Sums of ``size`` x ``size`` pixels, weighted by ``kernels`` (N, size², H, W), whose taps are in row-major order.

    The image (N, C, H + size - 1, W + size - 1) has size // 2 more pixels on every side.
    """
    height, width = kernels.shape[-2:]
    total = torch.zeros_like(image[..., :height, :width])
    # One tap after the other: all at once would take the memory of size² images. ``unbind``, because the gradient of
    # each slice would be a tensor of the size of all kernels.
    for tap, kernel in enumerate(kernels.unbind(1)):
        y, x = divmod(tap, size)
        total = total + kernel[:, None] * image[..., y : y + height, x : x + width]
    return total


def mixed(weights: Tensor, images: list[Tensor]) -> Tensor:
    """The sum of images (N, 3, H, W), each times its channel of ``weights`` (N, images, H, W)."""
    return torch.stack([weights[:, i : i + 1] * image for i, image in enumerate(images)]).sum(0)


def _mixed(op: Any, weights: Any, images: list[Any]) -> Any:
    """``mixed`` as nodes of a graph."""
    total = 0.0
    for i, image in enumerate(images):
        total = op.Slice(weights, [i], [i + 1], [1]) * image + total
    return total


def _softmax(op: Any, logits: Any) -> tuple[Any, Any]:
    """Nodes of the softmax over channels: its numerators, and their sum (N, 1, H, W).

    ONNX Runtime computes its own over the last axis only, between two transpositions of all channels.
    """
    weights = op.Exp(logits - op.ReduceMax(logits, [1], keepdims=1))
    return weights, op.ReduceSum(weights, [1], keepdims=1)


def _shifted(op: Any, image: Any, size: int) -> list[Any]:
    """Nodes of the image (N, C, H + size - 1, W + size - 1) as each tap of a kernel sees it, (N, C, H, W), by rows."""
    # The size of the image is unknown here, so slices end relative to its end; the last one ends beyond any size.
    ends = [n - size + 1 if n < size - 1 else 2**62 for n in range(size)]
    return [op.Slice(image, [y, x], [ends[y], ends[x]], [2, 3]) for y in range(size) for x in range(size)]


def head_of(start: tuple[str, ...], kernel: int, scales: int = 1, demodulate: bool = False) -> Head:
    """The head of a network that starts from these images: a ``Pyramid`` for ``kernel`` > 0, else pixel by pixel."""
    if kernel:
        return Pyramid(start, kernel, scales, demodulate)
    if not start:
        return Direct()
    return Residual(start) if len(start) == 1 else Mixture(start)
