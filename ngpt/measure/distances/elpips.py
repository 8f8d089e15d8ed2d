"""E-LPIPS: the distance of deep features, averaged over random transforms and dropout.

    d(a, b) = Σ_l  mean over pixels  Σ_c  w_lc (f_lc(a) / |f_l(a)| - f_lc(b) / |f_l(b)|)²

f_l are the features of layer l of a network, and c are their channels [Zhang et al. 2018, "The Unreasonable
Effectiveness of Deep Features as a Perceptual Metric", eq. 1; Kettunen et al. 2019, "E-LPIPS"]. The weights w are
fitted to people's judgements. They are those of E-LPIPS and must be given, because other weights would make another
metric.
"""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from ngpt.errors import NgptError

KEEP = 0.99


class FeatureDistance(nn.Module):
    """The distance of images (N, 3, H, W) in [0, 1], display-encoded, by a backbone and its fitted weights; float32.

    ``weights``  for each feature of the backbone, a vector of non-negative numbers, one for each channel
    """

    def __init__(self, backbone: nn.Module, weights: list[Tensor]):
        super().__init__()
        self.backbone = backbone
        for i, weight in enumerate(weights):
            self.register_buffer(f"weight{i}", weight.float())

    def forward(self, a: Tensor, b: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A scalar, the mean over the batch; with ``generator``, inputs of convolutions are dropped at random."""
        # Differences of features are too small for 16 bits.
        with torch.autocast(a.device.type, enabled=False):
            return self._distance(a.float(), b.float(), generator)

    def _distance(self, a: Tensor, b: Tensor, generator: torch.Generator | None) -> Tensor:
        count = len(a)

        def dropout(x: Tensor) -> Tensor:
            if generator is None:
                return x
            mask = torch.rand(count, *x.shape[1:], generator=generator, device=generator.device).to(x.device) < KEEP
            return x * torch.cat([mask, mask]) / KEEP

        images = 2 * torch.cat([a, b]) - 1
        total = images.new_zeros(())
        for i, feature in enumerate(self.backbone(images, dropout)):
            # Without the addend, the root's derivative would be infinite where all channels are 0.
            unit = feature / torch.sqrt(torch.sum(feature * feature, 1, keepdim=True) + 1e-12)
            difference = (unit[:count] - unit[count:]) ** 2
            total = total + torch.einsum("nchw,c->nhw", difference, self.get_buffer(f"weight{i}")).mean()
        return total


def read_weights(path: str, channels: tuple[int, ...]) -> list[Tensor]:
    """The fitted weights from a safetensors file with a vector ``lin0``, ``lin1``, ... for each feature."""
    if not path:
        raise NgptError(
            "loss.weights is not set: E-LPIPS needs its fitted weights, a safetensors file with vectors lin0 ... "
            f'lin{len(channels) - 1} (docs/train/losses.md); loss.kind = "structural" needs none'
        )
    if not Path(path).is_file():
        raise NgptError(f"{path}: no such file; it should hold the fitted weights of E-LPIPS (docs/train/losses.md)")
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise NgptError(f"{path}: not a readable safetensors file: {error}") from error
    weights = []
    for i, size in enumerate(channels):
        weight = tensors.get(f"lin{i}")
        if weight is None or weight.numel() != size:
            found = "missing" if weight is None else f"of {weight.numel()} numbers"
            raise NgptError(f"{path}: vector 'lin{i}' is {found}; it should have {size}")
        if not ((weight >= 0) & torch.isfinite(weight)).all():
            raise NgptError(f"{path}: vector 'lin{i}' holds numbers that are negative or not finite")
        weights.append(weight.flatten())
    return weights
