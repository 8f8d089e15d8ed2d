"""Denoises light groups so that they still add up to the image, for relighting in compositing.

A light group is the image in the light of some of the lamps. Each group is denoised by itself, because it has shadows
of its own. Let d_i be the denoised groups and D the denoised image. In each pixel, the difference between D and the sum
of the d_i is divided among the groups in proportion to their light:

    o_i = d_i + (D - Σ d_j) |d_i| / Σ |d_j|

So the results o_i add up to D for any method, and they are not negative if D and the d_i are not. Light that belongs to
no group counts as one more group.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.exr import layers_of_light, replace_layers_of_light
from ngpt.methods import METHODS, choose, reconstruct
from ngpt.panorama import WRAP, wraps
from ngpt.stack import GradientStack

# Renderer -> the name of a group's layer, with * in place of the group's own name
PATTERNS = {"Cycles": "Combined_*", "Arnold": "RGBA_*"}
# Header attribute of a result: the list of its groups
ATTRIBUTE = "ngpt:groups"
# If the share of light that belongs to no group is not above this, it counts as an error of rounding.
NEGLIGIBLE = 2e-3


def find(stack: GradientStack, patterns: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The light groups in the file of a stack: name -> (H, W, 3) float32.

    ``patterns``  patterns of layer names, such as "Combined_*"; by default ``PATTERNS``

    If a file has several view layers and that of the primal has groups, only these count. Raises NgptError if there are
    no groups, or if they are denoised already.
    """
    if ATTRIBUTE in stack.attributes:
        raise NgptError(f"{stack.path}: its light groups are denoised already; give the file of the renderer")
    wanted = tuple(patterns) or tuple(PATTERNS.values())
    layers = layers_of_light(stack)
    tails = {name: name.rpartition(".")[2] for name in layers}
    found = [name for name, tail in tails.items() if any(fnmatchcase(tail, p) or fnmatchcase(name, p) for p in wanted)]
    beside = stack.source.resolution["primal"].name.rpartition(".")[0] if stack.source else ""
    found = [name for name in found if name.rpartition(".")[0] == beside] or found
    if not found:
        others = ", ".join(layers) or "none"
        raise NgptError(
            f"{stack.path}: has no light groups called {' or '.join(wanted)}; other layers of colour: {others}; name "
            "them with --group NAME"
        )
    return {name: layers[name] for name in found}


def denoised(
    stack: GradientStack, groups: Mapping[str, np.ndarray], whole: np.ndarray, method: str = "auto", **options
) -> dict[str, np.ndarray]:
    """The denoised groups (H, W, 3) float32, which add up to ``whole``, the reconstruction of the stack's primal.

    ``method`` and ``options`` are those that made ``whole``. Groups have neither gradients nor variances. If the method
    needs gradients or variances, "auto" chooses another method for an image with the stack's features.
    """
    features = {name: stack[name] for name in ("albedo", "normal", "depth", "alpha") if name in stack}
    if method == "auto" or not set(METHODS[method].needs) <= {"primal", *features}:
        method, options = choose(("primal", *features)), {}
    light = {name: np.asarray(group, np.float32) for name, group in groups.items()}
    rest = stack["primal"] - np.sum(list(light.values()), axis=0, dtype=np.float64)
    if np.nansum(np.abs(rest)) > NEGLIGIBLE * np.nansum(np.abs(stack["primal"]), dtype=np.float64):
        light[""] = rest.astype(np.float32)
    wrap = {WRAP: 1} if wraps(stack) else {}
    stacks = [
        GradientStack({"primal": group, **features}, wrap, path=f"{stack.path}, {name}")
        for name, group in light.items()
    ]
    images = shares([reconstruct(one, method, **options).image for one in stacks], whole)
    return {name: image for name, image in zip(light, images, strict=True) if name}


def shares(parts: Sequence[np.ndarray], whole: np.ndarray) -> list[np.ndarray]:
    """The parts (H, W, 3), changed so that they add up to ``whole``; float32."""
    images = np.asarray(parts, np.float64)
    weights = np.abs(images)
    total = weights.sum(axis=0)
    # Where no part has light, all parts get the same share.
    weights = np.where(total > 0, weights / np.where(total > 0, total, 1), 1 / len(images))
    return list((images + weights * (whole - images.sum(axis=0))).astype(np.float32))


def with_groups(stack: GradientStack, groups: Mapping[str, np.ndarray]) -> GradientStack:
    """The stack with ``groups`` in place of its file's layers of these names, and a list of them in its header."""
    changed = replace_layers_of_light(stack, groups)
    return replace(changed, attributes=changed.attributes | {ATTRIBUTE: ", ".join(groups)})
