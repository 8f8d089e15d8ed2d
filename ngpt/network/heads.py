"""Heads compute the logarithm of the image from the prediction of a network. They have no trained weights.

    Direct     the prediction is the logarithm [Kettunen et al. 2019]
    Residual   the prediction corrects the logarithm of the image that the network starts from
    Mixture    the prediction has a weight for each of several images, and a correction of the logarithm of their mean
    Pyramid    the prediction has kernels, which filter one image at several resolutions; the results are blended from
               coarse to fine
               [Vogels et al. 2018, "Denoising with kernel prediction and asymmetric loss functions", section 4.3]

Each head is written once, for PyTorch and for ONNX graphs (``ngpt.network.operations``).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from ngpt.network.operations import Nodes, Tensors

# For ``Pyramid``: the least trust of a pixel.
LEAST_TRUST = 1e-4


@dataclass(frozen=True)
class Head(ABC):
    """The interface of all heads.

    ``start``    the images it reads, in order; names of ``ngpt.network.features.IMAGES``
    ``outputs``  the number of channels of the prediction
    ``reads``    the layers that ``forward`` gets: the images, and the other layers that the head reads
    ``radius``   the number of pixels by which these layers are larger than the prediction, on every side
    ``reach``    the distance, in pixels, up to which images and prediction influence the result of a pixel
    ``neutral``  whether a prediction of 0 gives a sensible image; if so, training begins with this prediction
    ``normalise``  whether the input of the last convolution is divided by its root mean square in each pixel. A softmax
                   does not limit its logits: without this division, features and logits would grow until nothing is
                   learnt
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

        ``prediction`` is (N, outputs, H, W) float32. ``images`` are the layers ``reads``, scene-linear and divided by
        the exposure, with ``radius`` more pixels on every side: (N, C, H + 2 radius, W + 2 radius).
        """

    @abstractmethod
    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        """``forward`` as nodes of an ONNX graph; ``op`` is as for ``Nodes``."""


class OwnHead(Head):
    """A head of this package, written once for PyTorch and for ONNX graphs."""

    @abstractmethod
    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        """Computes ``forward`` if ``math`` is ``Tensors``, and ``graph`` if it is ``Nodes``."""

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        return self.logarithm(Tensors, prediction, images)

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        return self.logarithm(Nodes(op), prediction, images)


class Direct(OwnHead):
    """The prediction is the logarithm."""

    neutral = False
    outputs = 3  # type: ignore[assignment]

    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        return prediction


class Residual(OwnHead):
    """The prediction corrects the logarithm of one image."""

    outputs = 3  # type: ignore[assignment]

    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        return prediction + math.signed_log(images[0])


class Mixture(OwnHead):
    """The prediction has a weight for each image (softmax), and corrects the logarithm of their weighted mean."""

    @property
    def outputs(self) -> int:
        return 3 + len(self.start)

    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        mean = math.mixed(math.part(prediction, 3, self.outputs), images)
        return math.part(prediction, 0, 3) + math.signed_log(mean)


@dataclass(frozen=True)
class Pyramid(OwnHead):
    """Filters an image by kernels at several resolutions.

    There are ``scales`` resolutions, each half as fine as the last. Kernels have ``size`` x ``size`` pixels.

    D is the image. If there are several, D is their mean, with weights from a softmax in each pixel. w in (0, 1) is the
    trust in each pixel of D. w_s is the mean of w over 2^s x 2^s pixels, and D_s is the mean of D over these pixels,
    weighted by w. k_s are the kernels; "down" takes means of 2 x 2 pixels, and "up" interpolates:

        I_s(p) = sum of k_s(p, q) w_s(q) D_s(q) / sum of k_s(p, q) w_s(q)       q in the kernel around p
        o_s    = I_s + a_s up(o_(s+1) - down(I_s)),  the coarsest o_s = I_s     a_s in (0, 1)

    o_0 is the result. If a rare bright path has hit a pixel, a low trust in this pixel keeps its light out of all
    neighbours, at every resolution [as in Gharbi et al. 2019, "Sample-based Monte Carlo denoising using a
    kernel-splatting network"]. The trust is divided by 1 + D, so that bright pixels do not dominate at the start of
    training. The predictions of k_s and a_s are averaged over the 2^s x 2^s pixels.

    ``demodulate``  the kernels average the image divided by the reflectance, and the result is multiplied by the
                    reflectance again, so texture is not averaged. The weight of a pixel is multiplied by its
                    reflectance, as in a least-squares fit of the image by the reflectance. Without this factor, a lamp
                    would spread ten times its light, because its albedo is 0 and its reflectance 0.1
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
        # At each scale: the radius of the kernel, one pixel for averaging, and one for bilinear interpolation.
        return sum((self.size // 2 + 2) << scale for scale in range(self.scales))

    @property
    def outputs(self) -> int:
        # The trust, a kernel for each scale, a share a_s for each scale but the coarsest, and the weights of several
        # images.
        return self.scales * (self.size**2 + 1) + self._weights

    @property
    def _weights(self) -> int:
        return len(self.start) if len(self.start) > 1 else 0

    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        image = images[0]
        if self._weights:
            logits = math.part(prediction, self.outputs - self._weights, self.outputs)
            image = math.mixed(logits, images[: self._weights])
        weight = (math.sigmoid(math.part(prediction, 0, 1)) + LEAST_TRUST) / (math.mean(abs(image)) + 1.0)
        if self.demodulate:
            image = image / images[-1]
            weight = weight * math.mean(images[-1])
        rest, taps = math.part(prediction, 1, self.outputs), self.size**2
        filtered, shares = [], []
        for scale in range(self.scales):
            if scale:
                light, weight = math.halved(image * weight), math.halved(weight)
                image, rest = light / weight, math.halved(math.part(rest, taps + 1, self.outputs))
            filtered.append(math.filtered(math.part(rest, 0, taps), image, weight, self.size))
            if scale + 1 < self.scales:
                shares.append(math.sigmoid(math.part(rest, taps, taps + 1)))
        result = filtered.pop()
        for fine, share in zip(reversed(filtered), reversed(shares), strict=True):
            result = fine + share * math.doubled(result - math.halved(fine))
        return math.signed_log(result * images[-1] if self.demodulate else result)


def head_of(start: tuple[str, ...], kernel: int, scales: int = 1, demodulate: bool = False) -> OwnHead:
    """The head of a network that starts from the images ``start``: a ``Pyramid`` for ``kernel`` > 0, else pixelwise."""
    if kernel:
        return Pyramid(start, kernel, scales, demodulate)
    if not start:
        return Direct()
    return Residual(start) if len(start) == 1 else Mixture(start)
