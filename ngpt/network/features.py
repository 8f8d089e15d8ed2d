"""From the layers of a stack to the channels a network reads. The only place that knows their order and scaling.

    primal       3   ln(1 + max(0, x))
    dx, dy       3   sgn(x) ln(1 + |x|)
    albedo       3   as it is, [0, 1]
    normal       3   as it is, camera space, [-1, 1]
    depth        1   over the image's largest, [0, 1]; 0 where the path escapes
    base         3   as primal: a classical reconstruction the network starts from
    primal_se, dx_se, dy_se
                 1   ln(1 + standard error of the layer of that name, mean over RGB)

[Kettunen et al. 2019, section 4.2 and their code; base and standard errors are ours.] Radiance is divided by the
exposure before. What a configuration does not list, the network does not see: absent layers are never filled with
zeros.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ngpt.exposure import BLOCK, KEY
from ngpt.network.transfer import signed_log

CHANNELS = {
    "primal": 3,
    "dx": 3,
    "dy": 3,
    "albedo": 3,
    "normal": 3,
    "depth": 1,
    "base": 3,
    "primal_se": 1,
    "dx_se": 1,
    "dy_se": 1,
}

# The layers that grow with the light of the scene.
RADIANCE = frozenset({"primal", "dx", "dy", "base", "primal_se", "dx_se", "dy_se"})


def channels(inputs: tuple[str, ...]) -> int:
    """The number of channels of these layers together."""
    return sum(CHANNELS[name] for name in inputs)


def encode(layers: Mapping[str, Tensor], inputs: tuple[str, ...]) -> Tensor:
    """(N, channels, H, W) from layers (N, C, H, W), with radiance divided by exposure and depth by its maximum."""
    return torch.cat([_encoded(name, layers[name]) for name in inputs], 1)


def _encoded(name: str, layer: Tensor) -> Tensor:
    if name in ("primal", "base"):
        return torch.log1p(torch.clamp(layer, min=0))
    if name in ("dx", "dy"):
        return signed_log(layer)
    if name.endswith("_se"):
        return torch.log1p(torch.mean(layer, 1, keepdim=True))
    return layer


def exposure(primal: Tensor) -> Tensor:
    """The typical radiance of images (N, 3, H, W), over ``KEY``: (N, 1, 1, 1), positive; 1 for black images.

    The median over blocks of 16x16 pixels, those that are not black, of their means: proportional to the image's
    brightness, the same at any sample count but for noise, and indifferent to what a few pixels hold. Wants finite
    values.
    """
    size = min(BLOCK, primal.shape[-2]), min(BLOCK, primal.shape[-1])
    blocks = avg_pool2d(primal.float().clamp(min=0).mean(1, keepdim=True), size, ceil_mode=True).flatten(1)
    values = torch.sort(blocks, 1, descending=True).values
    lit = torch.sum(values > 0, 1, keepdim=True)
    median = torch.gather(values, 1, torch.clamp(lit // 2, max=values.shape[1] - 1))
    return torch.where(lit > 0, median / KEY, torch.ones_like(median)).reshape(-1, 1, 1, 1)


def normalised(layers: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """The layers with radiance over exposure and depth over its maximum, and the exposure (N, 1, 1, 1).

    Both belong to the whole image: normalise before cutting tiles.
    """
    scale = exposure(layers["primal"])
    result = dict(layers)
    for name in RADIANCE & result.keys():
        result[name] = result[name] / scale
    if "depth" in result:
        result["depth"] = result["depth"] / (1e-10 + torch.amax(result["depth"], (1, 2, 3), keepdim=True))
    return result, scale
