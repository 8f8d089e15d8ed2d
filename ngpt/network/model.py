"""A complete neural reconstruction: the network, and the steps before and after it."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from ngpt.network import features, padding
from ngpt.network.config import ModelConfig
from ngpt.network.transfer import signed_exp, signed_log

# For ``quiet``. WINDOW is the side, in pixels, of the window over which variances are averaged, because variances of
# single pixels are too noisy. DARK is added to radiance before noise is divided by radiance. HUGE is a large number
# whose square is finite.
WINDOW, DARK, HUGE = 15, 0.01, 1e15


class Reconstructor(nn.Module):
    """Makes the image (N, 3, H, W) from layers (N, C, H, W), all scene-linear.

        exposure, depth scale -> padding -> channels -> network -> head -> (quiet) -> crop -> bounds -> exp -> exposure

    H and W are arbitrary. If the input is k times as bright, so is the result. The result is clamped to the least range
    that holds 0 and all values of the primal. The layers are those of ``ModelConfig.layers``, with finite values.

    For a network of OIDN's shape, OIDN's own steps take the place of these (``ngpt.network.oidnet``).
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.network: Any = config.kind.network(config)

    @property
    def alignment(self) -> int:
        """The number of pixels that both sides of the padded image must be divisible by."""
        return self.network.alignment

    @property
    def radius(self) -> int:
        """How far, in pixels, an input pixel influences the image, except through exposure, depth scale and bounds."""
        head = self.config.head
        # Pyramids and sweeps average the predictions of neighbouring pixels, so the distances of network and head add
        # up. Other heads read only neighbouring pixels of the input.
        moves = self.config.scales > 1 or self.config.sweeps
        own = self.network.radius + head.reach if moves else max(self.network.radius, head.reach)
        return max(own, WINDOW // 2 if self.config.quiet else 0)

    def forward(self, layers: Mapping[str, Tensor]) -> Tensor:
        if self.config.network == "oidn":
            return self.network.image(*(layers[name] for name in self.config.inputs))
        height, width = layers["primal"].shape[-2:]
        scaled, exposure = features.normalised({name: layers[name] for name in self.config.layers})
        bounds = self.bounds(scaled["primal"])
        pads = padding.pads(height, width, self.alignment)
        scaled = features.completed(scaled, self.config.inputs)
        logarithm = padding.crop(self.predict(padding.pad(scaled, pads)), pads)
        return signed_exp(torch.minimum(torch.maximum(logarithm, bounds[0]), bounds[1])) * exposure

    def predict(self, scaled: Mapping[str, Tensor]) -> Tensor:
        """The signed log of the image, unbounded, float32, from normalised, completed and padded layers."""
        if self.config.network == "oidn":
            return signed_log(self.network.image(*(scaled[name] for name in self.config.inputs)))
        # On CPUs, convolutions take half the time with channels last.
        x = features.encode(scaled, self.config.inputs).contiguous(memory_format=torch.channels_last)
        prediction = self.network(x).float()
        head = self.config.head
        images = dict(scaled)
        if "reflectance" in head.reads:
            images["reflectance"] = features.reflectance(scaled["albedo"])
        result = head.forward(prediction, [padding.extended(images[name], head.radius) for name in head.reads])
        if not self.config.quiet:
            return result
        base = signed_log(scaled["base"])
        return base + self.share(scaled) * (result - base)

    def share(self, scaled: Mapping[str, Tensor]) -> Tensor:
        """The weight of the network's result against the base, (N, 1, H, W) in [0, 1]; see ``ModelConfig.quiet``."""
        noise, light = scaled["primal_se"].clamp(max=HUGE).square(), scaled["base"].abs().clamp(max=HUGE)
        both = torch.cat([layer.mean(1, keepdim=True) for layer in (noise, light)], 1)
        variance, mean = avg_pool2d(both, WINDOW, 1, WINDOW // 2, count_include_pad=False).split(1, 1)
        share = (variance.sqrt() / (self.config.quiet * (mean + DARK))).clamp(max=1)
        # A variance of 0 means that it is unknown, or that no sample has found light yet.
        return torch.where(variance > 0, share, 1)

    @staticmethod
    def bounds(primal: Tensor) -> tuple[Tensor, Tensor]:
        """The least and the largest logarithm of the result for a primal (N, 3, H, W), (N, 1, 1, 1) each."""
        low, high = torch.aminmax(primal.flatten(1), dim=1)
        low, high = low.clamp(max=0), high.clamp(min=0)
        return signed_log(low).reshape(-1, 1, 1, 1), signed_log(high).reshape(-1, 1, 1, 1)


def parameters(module: nn.Module) -> int:
    """The number of parameters."""
    return sum(p.numel() for p in module.parameters())
