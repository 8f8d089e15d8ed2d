"""A perceptual distance averaged over random transforms, for the loss of training and for E-LPIPS as a metric."""

from collections.abc import Callable

import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.measure.distances import backbones, elpips, ensemble
from ngpt.measure.distances.structural import structural_distance
from ngpt.network.transfer import srgb

KINDS = ("structural", "elpips-squeeze", "elpips-vgg")


def tone_mapped(image: Tensor) -> Tensor:
    """R(x) = x / (1 + mean over channels of |x|), (N, 3, H, W), which keeps hues.

    As x grows, R tends to 1 for grey, and to 3 for a colour of only one channel [Kettunen et al. 2019, section 5.1, and
    their code].
    """
    return image / (1 + image.abs().mean(1, keepdim=True))


class PerceptualDistance:
    """A function of two images, scene-linear (N, 3, H, W) float32, and a generator on their device; returns a scalar.

    ``kind``         "structural" (no weights needed), "elpips-squeeze" (NGPT's) or "elpips-vgg"
    ``evaluations``  draws of the random transforms that are averaged
    ``scales``       largest downscaling among the transforms
    ``backbone``, ``weights``  files of E-LPIPS (docs/train/losses.md); "" looks for the backbone in PyTorch's cache

    Raises NgptError for an unknown kind, and for files that are missing or have the wrong contents.
    """

    def __init__(self, kind: str, evaluations: int, scales: int, backbone: str = "", weights: str = ""):
        if kind not in KINDS:
            raise NgptError(f"no perceptual distance '{kind}': choose one of: {', '.join(KINDS)}")
        self.evaluations, self.scales = evaluations, scales
        self._distance: Callable[..., Tensor] = lambda a, b, generator: structural_distance(a, b)
        if kind != "structural":
            network = backbones.SqueezeNet if kind == "elpips-squeeze" else backbones.Vgg16
            fitted = elpips.read_weights(weights, network.CHANNELS)
            self._distance = elpips.FeatureDistance(backbones.load(network, backbone), fitted)

    def __call__(self, image: Tensor, reference: Tensor, generator: torch.Generator) -> Tensor:
        if isinstance(self._distance, torch.nn.Module):
            self._distance.to(image.device)
        # As on a display: negative radiance clamped, tone-mapped, display-encoded.
        a, b = (srgb(tone_mapped(x.clamp(min=0))) for x in (image, reference))
        total = image.new_zeros(())
        for _ in range(self.evaluations):
            transform = ensemble.draw(len(a), a.shape[-2], a.shape[-1], generator, self.scales)
            total = total + self._distance(transform(a), transform(b), generator)
        return total / self.evaluations
