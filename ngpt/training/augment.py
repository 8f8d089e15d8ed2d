"""Random changes to training examples, as in NGPT. Each change keeps gradients consistent with the image.

An example is a dict of layers (C, H, W), among them "target", with radiance divided by the exposure. Transforms take
and return such dicts. [Kettunen et al. 2019, section 5.2 and their code]
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.network.features import RADIANCE
from ngpt.stack import GradientStack

Layers = dict[str, Tensor]

# The layers that are proportional to the light; and the layers whose three channels are colours.
_LIGHT = RADIANCE | {"target"}
_COLOR = _LIGHT | {"albedo"}
_VARIANCES = ("primal_var", "dx_var", "dy_var", "caustic_var")


@dataclass(frozen=True)
class Augmentation:
    """The random changes to each example.

    ``geometry``    flips and transposition, each with probability 1/2
    ``colors``      permutation of RGB, and a factor for each channel: 0..3, of mean 1, uniform on the simplex
    ``brightness``  standard deviation, in the logarithm, of a log-normal factor of mean 1 on radiance
    ``depth``       range of the factor of depth, uniform
    ``quieter``     range of a factor, log-uniform, one for each crop: adds an input with the noise of the crop's best
                    input times this factor. So networks learn to use more samples than training sets have. [] for none
    """

    geometry: bool = True
    colors: bool = True
    brightness: float = 1.0
    depth: tuple[float, float] = (0.1, 1.1)
    quieter: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "quieter", tuple(self.quieter))
        if self.quieter and not (len(self.quieter) == 2 and 0 < self.quieter[0] <= self.quieter[1] <= 1):
            raise NgptError(
                f"[augmentation]: quieter = {list(self.quieter)}: must be two factors, 0 < least <= most <= 1"
            )

    def __call__(self, layers: Mapping[str, Tensor], rng: np.random.Generator) -> Layers:
        result = dict(layers)
        if self.geometry:
            for transform in (flip_x, flip_y, transpose):
                if rng.random() < 0.5:
                    result = transform(result)
        if self.colors:
            factors = 3 * rng.dirichlet((1.0, 1.0, 1.0))
            result = color(result, rng.permutation(3), factors)
        if self.brightness:
            result = scale(result, float(np.exp(self.brightness * rng.standard_normal() - self.brightness**2 / 2)))
        if "depth" in result:
            result["depth"] = result["depth"] * float(rng.uniform(*self.depth))
        return result


def quieter(
    stack: GradientStack, reference: np.ndarray, direct: np.ndarray, caustic: np.ndarray, factor: float
) -> GradientStack:
    """The stack with its noise multiplied by ``factor``, as if it had 1 / factor² times the samples.

    The result is a weighted mean of the stack and the ``reference`` (H, W, 3). The reference includes directly visible
    emission and the light of the layer ``caustic``; ``direct`` and ``caustic`` hold these two parts of it. Features do
    not change.
    """
    light = reference - direct - caustic
    truth = {
        "primal": reference,
        "direct": direct,
        "caustic": caustic,
        "dx": np.diff(light, axis=1, append=light[:, -1:]),
        "dy": np.diff(light, axis=0, append=light[-1:]),
    }
    layers = {name: factor * stack[name] + (1 - factor) * truth[name] for name in truth if name in stack}
    layers |= {name: factor**2 * stack[name] for name in _VARIANCES if name in stack}
    return stack.replace(**layers)


def flip_x(layers: Mapping[str, Tensor]) -> Layers:
    """Mirrors left to right: I'[x] = I[W-1-x], so dx'[x] = -dx[W-2-x]. The unused column of dx stays the last one."""
    return _flip(layers, -1, "dx", 0)


def flip_y(layers: Mapping[str, Tensor]) -> Layers:
    """Mirrors top to bottom."""
    return _flip(layers, -2, "dy", 1)


def _flip(layers: Mapping[str, Tensor], axis: int, difference: str, normal: int) -> Layers:
    result = {name: layer.flip(axis) for name, layer in layers.items()}
    for name, sign in ((difference, -1), (f"{difference}_se", 1)):
        if name in result:
            result[name] = sign * result[name].roll(-1, axis)
    if "normal" in result:
        signs = torch.ones(3, 1, 1)
        signs[normal] = -1
        result["normal"] = result["normal"] * signs
    return result


def transpose(layers: Mapping[str, Tensor]) -> Layers:
    """Mirrors at the diagonal: rows become columns, and dx becomes dy.

    Image y points down and camera y up, so normals (x, y) become (-y, -x).
    """
    result = {name: layer.transpose(-1, -2) for name, layer in layers.items()}
    for a, b in (("dx", "dy"), ("dx_se", "dy_se")):
        if a in result:
            result[a], result[b] = result[b], result[a]
    if "normal" in result:
        x, y, z = result["normal"]
        result["normal"] = torch.stack([-y, -x, z])
    return result


def color(layers: Mapping[str, Tensor], order: np.ndarray, factors: np.ndarray) -> Layers:
    """The layers with permuted colours, each multiplied by its factor. Albedo may then exceed 1."""
    index, factor = torch.as_tensor(order), torch.as_tensor(factors, dtype=torch.float32).reshape(3, 1, 1)
    return {name: layer[index] * factor if name in _COLOR else layer for name, layer in layers.items()}


def scale(layers: Mapping[str, Tensor], factor: float) -> Layers:
    """The layers with all light ``factor`` times as bright."""
    return {name: layer * factor if name in _LIGHT else layer for name, layer in layers.items()}
