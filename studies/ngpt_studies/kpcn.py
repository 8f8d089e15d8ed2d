"""KPCN: kernels for diffuse and specular light, each predicted by a network of its own [Bako et al. 2017].

    diffuse, its error, features ── 5x5 ── ... ── 5x5 ── 1x1 ── kernels of diffuse / (albedo + ε) ── x (albedo + ε) ─┐
                                                                                                                     +
    specular, its error, features ─ 5x5 ── ... ── 5x5 ── 1x1 ── kernels of ln(1 + specular) ──────── exp - 1 ────────┘

"Kernel-Predicting Convolutional Networks for Denoising Monte Carlo Renderings", sections 4 and 5. There are three
differences from the paper:

- The last convolution is 1x1 and reads normalised features, as in all our networks with a softmax head.
- Both networks read logarithms, since one path may be a thousand times as bright as its pixel. Kernels average the same
  values as in the paper.
- The inputs do not include gradients and variances of the features.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ngpt.errors import NgptError
from ngpt.network.config import Kind, ModelConfig, check_layers, last_of
from ngpt.network.features import CHANNELS, PARTS
from ngpt.network.heads import Head
from ngpt.network.operations import averaged
from ngpt.network.transfer import signed_exp, signed_log
from ngpt.network.unet import Convolution, LastConvolution

# Added to albedo before light is divided by it [section 5.1].
EPSILON = 0.00316
# The inputs that are required
NEEDED = ("primal", *PARTS, "albedo")
# The side of the paper's kernels. Where a kernel reaches beyond the padding, the border of the padding is repeated.
MAX_KERNEL = 21
# The largest logarithm for which float32 holds the light divided by EPSILON
LARGEST = 80.0


class KPCN(nn.Module):
    """Both networks: from channels (N, C, H, W) of ``ngpt.network.features.encode`` to logits (N, outputs, H, W).

    Each network reads its own part of the light, the standard error of that, and all other inputs except the primal.

    ``inputs``   the layers of these channels, in order; they must include ``NEEDED``
    ``width``    the number of channels of each 5x5 convolution
    ``layers``   the number of 5x5 convolutions in each network
    ``outputs``  the number of logits of both networks, diffuse light first
    ``zero``, ``normalise``  as in ``LastConvolution``
    ``radius``   the radius of the receptive field
    """

    alignment = 1

    def __init__(
        self,
        inputs: tuple[str, ...],
        width: int,
        layers: int,
        outputs: int,
        zero: bool = False,
        normalise: bool = False,
    ):
        super().__init__()
        self.inputs, self.radius = inputs, 2 * layers
        self.bodies, self.heads = nn.ModuleDict(), nn.ModuleDict()
        for part in PARTS:
            channels = sum(CHANNELS[name] for name in self._read(part))
            sizes = [channels, *[width] * layers]
            convolutions = [Convolution(a, b, "5x5") for a, b in pairwise(sizes)]
            self.bodies[part] = nn.Sequential(*convolutions)
            self.heads[part] = LastConvolution(width, outputs // len(PARTS), zero, normalise)

    def _read(self, part: str) -> list[str]:
        others = {name for other in PARTS if other != part for name in (other, f"{other}_se")}
        return [name for name in self.inputs if name != "primal" and name not in others]

    def forward(self, x: Tensor) -> Tensor:
        layers = dict(zip(self.inputs, x.split([CHANNELS[name] for name in self.inputs], 1), strict=True))
        diffuse = torch.expm1(layers["diffuse"].clamp(max=LARGEST))
        layers["diffuse"] = torch.log1p(diffuse / (layers["albedo"] + EPSILON))
        logits = []
        for part in PARTS:
            read = torch.cat([layers[name] for name in self._read(part)], 1)
            logits.append(self.heads[part](self.bodies[part](read.contiguous(memory_format=torch.channels_last))))
        return torch.cat(logits, 1)


@dataclass(frozen=True)
class SplitKernels(Head):
    """Weights (softmax) of ``size`` x ``size`` pixels around each pixel, for each of the two parts of the light."""

    start: tuple[str, ...] = PARTS
    normalise: ClassVar[bool] = True

    size: int = MAX_KERNEL

    @property
    def reads(self) -> tuple[str, ...]:
        return (*self.start, "albedo")

    @property
    def radius(self) -> int:
        return self.size // 2

    @property
    def outputs(self) -> int:
        return len(self.start) * self.size**2

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        height, width = prediction.shape[-2:]
        diffuse, specular, albedo = images
        of_diffuse, of_specular = (torch.softmax(logits, 1) for logits in prediction.chunk(2, 1))
        reflectance = albedo + EPSILON
        r = self.radius
        light = averaged(of_diffuse, diffuse / reflectance, self.size) * reflectance[..., r : r + height, r : r + width]
        return signed_log(light + signed_exp(averaged(of_specular, signed_log(specular), self.size)))

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        raise NgptError("network 'kpcn' cannot be exported, since it has no ONNX graph; run it in PyTorch")


class Kpcn(Kind):
    """The kind of network "kpcn".

    In its configuration, ``channels`` has one entry, the width of the convolutions, and ``units`` has one, their
    number. ``kernel`` is the side of the kernels of both parts of the light.
    """

    goes_without = ("base", "start", "quiet", "scales", "demodulate", "sweeps", "pooling")

    def check(self, config: ModelConfig) -> None:
        check_layers(config, units=True)
        if missing := [name for name in NEEDED if name not in config.inputs]:
            raise NgptError(f"network 'kpcn' needs the inputs {', '.join(NEEDED)}; lacks {', '.join(missing)}")
        if type(config.kernel) is not int or config.kernel not in range(3, MAX_KERNEL + 1, 2):
            most = MAX_KERNEL
            raise NgptError(f"kernel = {config.kernel!r}: must be an odd number from 3 to {most} for 'kpcn'")
        if len(config.channels) > 1:
            raise NgptError(f"channels {list(config.channels)}: 'kpcn' has one level; give one number")

    def head(self, config: ModelConfig) -> Head:
        return SplitKernels(size=config.kernel)

    def network(self, config: ModelConfig) -> nn.Module:
        return KPCN(config.inputs, config.channels[0], config.units[0], **last_of(config))


KIND = Kpcn()
