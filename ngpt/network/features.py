"""Turns the layers of a stack into the channels that a network reads. Their order and scaling are defined only here.

    primal       3   ln(1 + max(0, x))
    dx, dy       3   sgn(x) ln(1 + |x|)
    albedo       3   unchanged, [0, 1]
    normal       3   unchanged, camera space, [-1, 1]
    diffuse, specular
                 3   as primal: light by the lobe of its first scattering event
    depth        1   divided by the largest depth of the image, [0, 1]; 0 where the path escapes
    base         3   as primal: a classical reconstruction that the network starts from
    denoised, denoised_base
                 3   as primal: another denoiser's images of the primal and of the base (``ngpt.network.inputs``)
    primal_se, dx_se, dy_se, diffuse_se, specular_se
                 1   ln(1 + standard error of the layer of that name, mean over RGB)

The following channels are relative to an image D, and enlarged so that 16 bits can hold small differences. L is the
signed log. D is the base if "base" is among the inputs, otherwise the denoised image:

    primal_change, base_change, denoised_base_change
                 3   L(20 (L(x) - L(D)))
    dx_base, dy_base, dx_denoised, dy_denoised, dx_denoised_base, dy_denoised_base
                 3   L(20 (dx - ΔX) / (1 + |D|)), with X the image in the name: 0 where X agrees with the gradients
    primal_noise, dx_noise, dy_noise
                 1   ln(1 + 100 standard error / (1 + |D|)), means over RGB

[Kettunen et al. 2019, section 4.2 and their code; the base and standard errors are not in the paper.] Before, radiance
is divided by the exposure. A network gets only the layers in its configuration: missing layers are never replaced by
zeros.
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

# Factors of differences to an image and of relative noise; a number that is added to the divisor of depth.
ENLARGED, NOISE_ENLARGED, LEAST_DEPTH = 20, 100, 1e-10

# Added to the albedo before radiance is divided by it, because dark surfaces have gloss, too.
GLOSS = 0.1

# Computed layer -> the layers that it is computed from, in addition to ``compared``.
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
    """The layers that these inputs are or are computed from."""
    beside = (compared(inputs),)
    return tuple(
        dict.fromkeys(source for name in inputs for source in (SOURCES[name] + beside if name in SOURCES else (name,)))
    )


def compared(inputs: tuple[str, ...]) -> str:
    """The name of the image D that computed inputs are relative to."""
    return "base" if "base" in inputs else "denoised"


def completed(layers: Mapping[str, Tensor], inputs: tuple[str, ...]) -> dict[str, Tensor]:
    """The normalised layers, with the ``inputs`` that are computed from them; before any padding."""
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

    Because of the addend, a noisy albedo between 0 and 0.1 changes the demodulated light little.
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

    The typical radiance is the median of the means of blocks of 16x16 pixels that are not black. It is proportional to
    the brightness of the image. Neither a few pixels nor the number of samples change it, except for noise. ``primal``
    must be finite.
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
    those of the given layers: normalise whole images, not tiles.
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
