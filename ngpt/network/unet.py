"""The dense U-Net of NGPT, and a plain U-Net of equal capacity.

    level 0   input ─ units ───────────────────────────────┬─ units ─ head ─ RGB
                         └─ pool                        unpool
    level 1                └─ units ────────────┬─ units ─┘
                                └─ pool      unpool
    level 2                       └─ units ─ units ┘          (... one block more for each level)

Every level of the dense U-Net has one growing list of tensors: its input, the outputs of the units on the way down, the
tensor from the level below, and the outputs of the units on the way up. Each unit, the pool, the unpool and the head
read the whole list [Kettunen et al. 2019, section 4.1 and figure 5]. Weights are normalised, activations are leaky ReLU
with slope 0.01, and convolutions pad with zeros.

Both sides of the input must be divisible by 2^(levels - 1), which ``ngpt.network.padding`` ensures.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, conv_transpose2d, interpolate, leaky_relu, max_pool2d

SLOPE = 0.01
# How sizes are halved and doubled. The paper uses the first way, and compares it with the others [section 4.4.5].
POOLING = ("convolution", "average", "maximum", "bilinear")


class Convolution(nn.Module):
    """A convolution with a bias, and with normalised weights: w = √2 s v / |v| for each output channel.

    The factor √2 makes leaky ReLUs preserve the variance from the first step on [Salimans and Kingma 2016, eq. 2; He et
    al. 2015]. The kinds "1x1", "3x3" and "5x5" keep the size of the image. "pool" is 2x2 with stride 2, and halves the
    size; "unpool" is its transpose, and doubles it.
    """

    def __init__(self, inputs: int, outputs: int, kind: str, activation: bool = True):
        super().__init__()
        self.kind, self.activation = kind, activation
        self.transposed = kind == "unpool"
        size = {"1x1": 1, "3x3": 3, "5x5": 5, "pool": 2, "unpool": 2}[kind]
        shape = (inputs, outputs, size, size) if self.transposed else (outputs, inputs, size, size)
        self.v = nn.Parameter(torch.empty(shape))
        self.s = nn.Parameter(torch.ones(outputs))
        self.bias = nn.Parameter(torch.zeros(outputs))
        # The output depends only on the direction of v. The length of v determines how fast Adam rotates v.
        std = 1.612 / math.sqrt(inputs * size * size)
        nn.init.trunc_normal_(self.v, std=std, a=-2 * std, b=2 * std)

    def weight(self) -> Tensor:
        """The normalised weights, in the layout of PyTorch's convolutions."""
        output = 1 if self.transposed else 0
        others = [axis for axis in range(4) if axis != output]
        norm = torch.sqrt(1e-8 + torch.sum(self.v * self.v, others, keepdim=True))
        shape = [1, 1, 1, 1]
        shape[output] = -1
        return self.v * (math.sqrt(2) * self.s.reshape(shape) / norm)

    def forward(self, x: Tensor) -> Tensor:
        if self.transposed:
            x = conv_transpose2d(x, self.weight(), self.bias, stride=2)
        elif self.kind == "pool":
            x = conv2d(x, self.weight(), self.bias, stride=2)
        else:
            x = conv2d(x, self.weight(), self.bias, padding="same")
        return leaky_relu(x, SLOPE) if self.activation else x


class Resampling(nn.Module):
    """A 1x1 convolution, followed by a fixed rule that halves or doubles the size [Kettunen et al. 2019, figure 12].

    ``pooling``  "average": means of 2x2 pixels; "maximum": the largest of 2x2 pixels; with both, doubling repeats each
                 pixel. "bilinear": doubling interpolates bilinearly, and halving takes means of 2x2 pixels
    ``up``       whether the size is doubled
    """

    def __init__(self, inputs: int, outputs: int, pooling: str, up: bool):
        super().__init__()
        self.pooling, self.up = pooling, up
        self.convolution = Convolution(inputs, outputs, "1x1")

    def forward(self, x: Tensor) -> Tensor:
        x = self.convolution(x)
        if self.up:
            return interpolate(x, scale_factor=2.0, mode="bilinear" if self.pooling == "bilinear" else "nearest")
        return max_pool2d(x, 2) if self.pooling == "maximum" else avg_pool2d(x, 2)


def resampled(inputs: int, outputs: int, pooling: str, up: bool) -> nn.Module:
    """The module that halves the size of an image, or doubles it if ``up``; ``pooling`` is one of ``POOLING``."""
    if pooling == "convolution":
        return Convolution(inputs, outputs, "unpool" if up else "pool")
    return Resampling(inputs, outputs, pooling, up)


class LastConvolution(nn.Module):
    """The 1x1 convolution to ``outputs`` channels: in float32 even under autocast, and without activation.

    It predicts logarithms: rounding them to 16 bits would change radiance by some per cent.

    ``zero``       whether the weights start at 0, for predictions where 0 is sensible, such as corrections. If so, the
                   weights are not normalised, because a zero vector has no direction
    ``normalise``  whether the input is divided by its root mean square in each pixel; needs ``zero``
    """

    def __init__(self, inputs: int, outputs: int, zero: bool, normalise: bool = False):
        super().__init__()
        self.normalise = normalise
        self.convolution: nn.Conv2d | Convolution
        if zero:
            self.convolution = nn.Conv2d(inputs, outputs, 1)
            for parameter in self.convolution.parameters():
                nn.init.zeros_(parameter)
        else:
            self.convolution = Convolution(inputs, outputs, "1x1", activation=False)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            x = x.float()
            if not self.normalise or isinstance(self.convolution, Convolution):
                return self.convolution(x)
            # In ONNX Runtime, a convolution to one channel is the fastest mean over channels. The output is divided in
            # place of the input, because the output has fewer channels.
            square = conv2d(x * x, x.new_full((1, x.shape[1], 1, 1), 1 / x.shape[1]))
            bias = self.convolution.bias
            assert bias is not None
            return conv2d(x, self.convolution.weight) * torch.rsqrt(square + 1e-8) + bias[:, None, None]


class Unit(nn.Module):
    """A unit of a dense block: a 1x1 convolution to 2g channels, and a 3x3 convolution to g channels."""

    def __init__(self, inputs: int, growth: int):
        super().__init__()
        self.squeeze = Convolution(inputs, 2 * growth, "1x1")
        self.grow = Convolution(2 * growth, growth, "3x3")

    def forward(self, tensors: list[Tensor]) -> Tensor:
        return self.grow(self.squeeze(torch.cat(tensors, 1)))


def radius(convolutions: list[int], pooling: str) -> int:
    """The radius in pixels of the receptive field, for the number of 3x3 convolutions at each level, finest first.

    A convolution reaches as far as a pixel of its level is wide. A pixel of the coarsest level spreads values over its
    whole area, and bilinear interpolation also to the next pixel.
    """
    spread = (1 << len(convolutions) - 1) - 1
    return sum(n << level for level, n in enumerate(convolutions)) + spread * (2 if pooling == "bilinear" else 1)


class DenseUNet(nn.Module):
    """Maps (N, inputs, H, W) to (N, outputs, H, W), with H and W divisible by ``alignment``.

    ``growth``   for each level, the number of channels that each unit adds
    ``units``    for each level, the number of units on the way down, and again on the way up
    ``zero``, ``normalise``  see ``LastConvolution``
    ``pooling``  one of ``POOLING``
    ``radius``   the radius of the receptive field in pixels
    """

    def __init__(
        self,
        inputs: int,
        growth: tuple[int, ...],
        units: tuple[int, ...],
        outputs: int = 3,
        zero: bool = False,
        normalise: bool = False,
        pooling: str = "convolution",
    ):
        super().__init__()
        levels = len(growth)
        self.alignment = 2 ** (levels - 1)
        self.radius = radius([2 * n for n in units], pooling)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        self.pool, self.unpool = nn.ModuleList(), nn.ModuleList()
        channels, dense = inputs, []
        for level, (g, n) in enumerate(zip(growth, units, strict=True)):
            self.down.append(nn.ModuleList(Unit(channels + i * g, g) for i in range(n)))
            dense.append(channels + n * g)
            if level + 1 < levels:
                channels = 2 * growth[level + 1]
                self.pool.append(resampled(dense[level], channels, pooling, up=False))
        for level in reversed(range(levels)):
            g, n = growth[level], units[level]
            if level + 1 < levels:
                self.unpool.insert(0, resampled(dense[level + 1], 2 * g, pooling, up=True))
                dense[level] += 2 * g
            self.up.insert(0, nn.ModuleList(Unit(dense[level] + i * g, g) for i in range(n)))
            dense[level] += n * g
        self.head = LastConvolution(dense[0], outputs, zero, normalise)

    def forward(self, x: Tensor) -> Tensor:
        lists = []
        for level, units in enumerate(self.down):
            tensors = [x]
            for unit in units:  # type: ignore[attr-defined]
                tensors.append(unit(tensors))
            lists.append(tensors)
            if level < len(self.pool):
                x = self.pool[level](torch.cat(tensors, 1))
        for level in reversed(range(len(lists))):
            if level < len(self.unpool):
                lists[level].append(self.unpool[level](torch.cat(lists[level + 1], 1)))
            for unit in self.up[level]:  # type: ignore[attr-defined]
                lists[level].append(unit(lists[level]))
        return self.head(torch.cat(lists[0], 1))


class PlainUNet(nn.Module):
    """A U-Net with two 3x3 convolutions for each level and direction, and one skip connection for each level.

    It maps (N, inputs, H, W) to (N, outputs, H, W). ``widths`` are the channels of the levels; all else is as in
    ``DenseUNet``.
    """

    def __init__(
        self,
        inputs: int,
        widths: tuple[int, ...],
        outputs: int = 3,
        zero: bool = False,
        normalise: bool = False,
        pooling: str = "convolution",
    ):
        super().__init__()
        self.alignment = 2 ** (len(widths) - 1)
        self.radius = radius([4] * (len(widths) - 1) + [2], pooling)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        self.pool, self.unpool = nn.ModuleList(), nn.ModuleList()
        channels = inputs
        for level, width in enumerate(widths):
            self.down.append(nn.Sequential(Convolution(channels, width, "3x3"), Convolution(width, width, "3x3")))
            if level + 1 < len(widths):
                self.pool.append(resampled(width, width, pooling, up=False))
                self.unpool.append(resampled(widths[level + 1], width, pooling, up=True))
                self.up.append(nn.Sequential(Convolution(2 * width, width, "3x3"), Convolution(width, width, "3x3")))
            channels = width
        self.head = LastConvolution(widths[0], outputs, zero, normalise)

    def forward(self, x: Tensor) -> Tensor:
        skips = []
        for level, block in enumerate(self.down):
            x = block(x)
            if level < len(self.pool):
                skips.append(x)
                x = self.pool[level](x)
        for level in reversed(range(len(skips))):
            x = self.up[level](torch.cat([skips[level], self.unpool[level](x)], 1))
        return self.head(x)
