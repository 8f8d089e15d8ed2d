"""Turns the layers of a stack into the channels that a network reads. Their order and scaling are defined only here.

    primal       3   ln(1 + max(0, x))
    dx, dy       3   sgn(x) ln(1 + |x|)
    albedo       3   unchanged, [0, 1]
    normal       3   unchanged, camera space, [-1, 1]
    diffuse, specular
                 3   as primal: the light, split by the lobe of its first scattering event
    depth        1   divided by the largest depth of the image, [0, 1]; 0 where the path escapes
    base         3   as primal: a classical reconstruction that the network starts from
    denoised, denoised_base
                 3   as primal: another denoiser's images of the primal and of the base (``ngpt.network.inputs``)
    primal_se, dx_se, dy_se, diffuse_se, specular_se
                 1   ln(1 + e), with e the standard error of that layer, averaged over RGB

L is the signed log, sgn(x) ln(1 + |x|). The following channels are relative to an image D: the base if "base" is among
the inputs, otherwise the denoised image. Differences are multiplied by 20 and noise by 100, so that 16 bits can hold
small values:

    primal_change, base_change, denoised_base_change
                 3   L(20 (L(x) - L(D)))
    dx_base, dy_base, dx_denoised, dy_denoised, dx_denoised_base, dy_denoised_base
                 3   L(20 (dx - ΔX) / (1 + |D|)). X is the image in the name, ΔX its pixel differences; 0 where X agrees
                     with the gradients
    primal_noise, dx_noise, dy_noise
                 1   ln(1 + 100 e / (1 + d)), with e the standard error and d = |D|, both averaged over RGB

[Kettunen et al. 2019, section 4.2 and their code; the base and standard errors are not in the paper.] Before encoding,
radiance is divided by the exposure. A network gets only the layers in its configuration: missing layers are never
replaced by zeros.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ngpt.network.exposure import BLOCK, KEY
from ngpt.network.inputs import DENOISED, MADE
from ngpt.network.transfer import signed_log

CHANNELS = {
    name: 1 if name == "depth" or name.endswith(("_se", "_noise")) else 3
    for name in (
        *("primal", "dx", "dy", "albedo", "normal", "depth", "diffuse", "specular"),
        *("base", "denoised", "denoised_base"),
        *("primal_se", "dx_se", "dy_se", "diffuse_se", "specular_se"),
        *("primal_change", "base_change", "denoised_base_change"),
        *("dx_base", "dy_base", "dx_denoised", "dy_denoised", "dx_denoised_base", "dy_denoised_base"),
        *("primal_noise", "dx_noise", "dy_noise"),
    )
}

# Factors by which differences to D and relative noise are multiplied; and a number that is added to the divisor of
# depth, so that it is never 0.
ENLARGED, NOISE_ENLARGED, LEAST_DEPTH = 20, 100, 1e-10

# Radiance is divided by albedo + GLOSS, because surfaces with a dark albedo may still reflect light as gloss.
GLOSS = 0.1

# Computed layer -> the layers from which it is computed, besides the image D (``compared``).
SOURCES = {
    **{f"{name}_change": (name,) for name in ("primal", "base", "denoised_base")},
    **{f"{axis}_{name}": (axis, name) for axis in ("dx", "dy") for name in ("base", *DENOISED)},
    **{f"{name}_noise": (f"{name}_se",) for name in ("primal", "dx", "dy")},
}

# The layers that are proportional to the light of the scene.
RADIANCE = frozenset(
    {"primal", "dx", "dy", "base", "denoised", "denoised_base", "primal_se", "dx_se", "dy_se"}
    | {"diffuse", "specular", "diffuse_se", "specular_se"}
)

# The images of the scene that a network may start from.
IMAGES = ("primal", *MADE)

# The images of parts of the scene's light.
PARTS = ("diffuse", "specular")


def channels(inputs: tuple[str, ...]) -> int:
    """The number of channels of all these layers."""
    return sum(CHANNELS[name] for name in inputs)


def sources(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """The layers that are inputs themselves, or from which inputs are computed."""
    beside = (compared(inputs),)
    return tuple(
        dict.fromkeys(source for name in inputs for source in (SOURCES[name] + beside if name in SOURCES else (name,)))
    )


def compared(inputs: tuple[str, ...]) -> str:
    """The name of the image D that computed inputs are relative to."""
    return "base" if "base" in inputs else "denoised"


def completed(layers: Mapping[str, Tensor], inputs: tuple[str, ...]) -> dict[str, Tensor]:
    """The normalised ``layers``, not yet padded, and those of the ``inputs`` that are computed from them."""
    return dict(layers) | {name: _computed(name, layers, compared(inputs)) for name in inputs if name in SOURCES}


def _computed(name: str, layers: Mapping[str, Tensor], compared_with: str) -> Tensor:
    other = layers[compared_with]
    if name.endswith("_change"):
        return signed_log(layers[SOURCES[name][0]]) - signed_log(other)
    if name.endswith("_noise"):
        error = layers[SOURCES[name][0]].mean(-3, keepdim=True)
        return error / (1 + other.abs().mean(-3, keepdim=True))
    axis = -1 if name.startswith("dx") else -2
    image = layers[SOURCES[name][1]]
    last = image.narrow(axis, image.shape[axis] - 1, 1)
    return (layers[name[:2]] - torch.diff(image, dim=axis, append=last)) / (1 + other.abs())


def reflectance(albedo: Tensor) -> Tensor:
    """The divisor of radiance (N, 3, H, W) for demodulation: albedo + ``GLOSS``.

    Because ``GLOSS`` is added, noise in an albedo between 0 and 0.1 changes the quotient little.
    """
    return albedo + GLOSS


def encode(layers: Mapping[str, Tensor], inputs: tuple[str, ...]) -> Tensor:
    """The channels (N, channels, H, W) of normalised and completed layers (N, C, H, W)."""
    return torch.cat([_encoded(name, layers[name]) for name in inputs], 1)


def _encoded(name: str, layer: Tensor) -> Tensor:
    if name in (*IMAGES, *PARTS):
        return torch.log1p(torch.clamp(layer, min=0))
    if name in ("dx", "dy"):
        return signed_log(layer)
    if name.endswith("_noise"):
        return torch.log1p(NOISE_ENLARGED * layer)
    if name in SOURCES:
        return signed_log(ENLARGED * layer)
    if name.endswith("_se"):
        return torch.log1p(torch.mean(layer, 1, keepdim=True))
    return layer


def exposure(primal: Tensor) -> Tensor:
    """The typical radiance of images (N, 3, H, W) divided by ``KEY``: (N, 1, 1, 1), positive; 1 for black images.

    The image is cut into blocks of 16x16 pixels. The typical radiance is the median of the means of all blocks that are
    not black. It is proportional to the brightness of the image. It depends neither on a few bright pixels nor, apart
    from noise, on the number of samples. ``primal`` must be finite.
    """
    size = min(BLOCK, primal.shape[-2]), min(BLOCK, primal.shape[-1])
    blocks = avg_pool2d(primal.float().clamp(min=0).mean(1, keepdim=True), size, ceil_mode=True).flatten(1)
    values = torch.sort(blocks, 1, descending=True).values
    lit = torch.sum(values > 0, 1, keepdim=True)
    median = torch.gather(values, 1, torch.clamp(lit // 2, max=values.shape[1] - 1))
    return torch.where(lit > 0, median / KEY, torch.ones_like(median)).reshape(-1, 1, 1, 1)


def normalised(layers: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """The normalised layers, and the exposure (N, 1, 1, 1).

    Radiance is divided by the exposure, depth by its maximum, and albedo is clamped to [0, 1]. Exposure and maximum are
    those of the given layers, so these must be whole images, not tiles.
    """
    scale = exposure(layers["primal"])
    result = dict(layers)
    for name in RADIANCE & result.keys():
        result[name] = result[name] / scale
    if "albedo" in result:
        # Some renderers write the brightness of lamps as their albedo.
        result["albedo"] = result["albedo"].clamp(0, 1)
    if "depth" in result:
        result["depth"] = result["depth"] / (LEAST_DEPTH + torch.amax(result["depth"], (1, 2, 3), keepdim=True))
    return result, scale
