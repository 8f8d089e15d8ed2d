"""Gathers the inputs of networks from a repaired stack: the same arrays for PyTorch and for ONNX Runtime.

    primal, dx, dy, albedo, normal, depth      layers of the stack
    diffuse, specular                          layers of the stack: light, split by the lobe of its first
                                               scattering event
    primal_var, dx_var, dy_var                 variances of the layers, NaN where unknown (for ONNX graphs)
    primal_se, dx_se, dy_se, diffuse_se, specular_se
                                               standard errors: roots of the variances, 0 where unknown (for PyTorch)
    base                                       a classical reconstruction of ``ngpt.classical.bases``
    denoised, denoised_base                    OIDN's images of the primal and of the base

All radiance excludes directly visible emission. OIDN removes less noise from the base than from the primal. So OIDN's
image of the base has other errors than its image of the primal, and a network can combine both images [after Back et
al. 2020, "Deep Combiner for Independent and Correlated Pixel Estimates"; here a denoised image of the correlated
estimate takes the place of their kernel].
"""

from collections.abc import Collection
from dataclasses import replace
from functools import cached_property

import numpy as np

from ngpt.classical.bases import BASES, CLASSICAL
from ngpt.denoisers import caustic, clean
from ngpt.denoisers.oidn import of_both, oidn, with_clean_features
from ngpt.errors import NgptError
from ngpt.network.estimates import with_variances
from ngpt.repair import Repaired

# The layers of a stack that networks may read, in the order in which they are listed.
LAYERS = (
    *("primal", "dx", "dy", "albedo", "normal", "depth", "primal_var", "dx_var", "dy_var"),
    *("diffuse", "specular", "diffuse_var", "specular_var"),
)

# Another denoiser's images of the primal and of the base.
DENOISED = ("denoised", "denoised_base")

# The inputs that are made from the layers of a stack.
MADE = ("base", *DENOISED)

# The variances that can be estimated if a stack with gradients lacks them.
ESTIMATED = ("primal_var", "dx_var", "dy_var")


def needs(names: Collection[str], base: str) -> tuple[str, ...]:
    """The layers that a stack must hold for these inputs of ``gather``, in the order of ``LAYERS``.

    Unknown names come last, as does "base" if an input is made from the base but ``base`` is "".
    """
    wanted = {"primal"} | {_layer(name) for name in names if name not in MADE}
    if set(DENOISED) & set(names):
        wanted |= {"albedo", "normal"}
    if base:
        wanted |= set(BASES[base].needs)
    elif {"base", "denoised_base"} & set(names):
        wanted |= {"base"}
    return tuple(name for name in LAYERS if name in wanted) + tuple(sorted(wanted - set(LAYERS)))


def gather(
    data: Repaired, names: Collection[str], base: str, reader: str = "the network's settings", estimate: bool = False
) -> dict:
    """The inputs ``names`` of a network that starts from ``base`` ("" for none): arrays (H, W, C) by name.

    ``reader``    the subject of the message about missing layers
    ``estimate``  whether to estimate variances that a stack with gradients lacks (``ngpt.network.estimates``)

    Raises NgptError if the stack lacks layers for the inputs, or if they need OIDN and it is not installed.
    """
    wanted = needs(names, base)
    by_oidn = data.by_oidn or Oidn(data)
    if estimate and data.dx is not None and set(ESTIMATED) & set(wanted) - data.known_variances().keys():
        # OIDN's image is the better guide, but is only used if the network reads it anyway.
        guide = by_oidn.of_primal if set(DENOISED) & set(names) else CLASSICAL["l1"](data)
        data = with_variances(data, guide)
    held = {"primal": data.image, **data.features, **data.parts, **data.known_variances()}
    if data.dx is not None:
        held |= {"dx": data.dx, "dy": data.dy}
    if lacking := [name for name in wanted if name not in held]:
        raise NgptError(f"{reader} need layers {', '.join(lacking)}, which the stack lacks")
    made = {name: _standard_error(held[_layer(name)]) for name in names if name.endswith("_se")}
    if {"base", "denoised_base"} & set(names):
        made["base"] = base_image(data, base)
    arrays = held | made | denoised(by_oidn, made.get("base"), names)
    return {name: arrays[name] for name in names}


def base_image(data: Repaired, base: str) -> np.ndarray:
    """The reconstruction that a network starts from, (H, W, 3) float32, without direct emission."""
    # For extreme values, intermediate results may exceed the range of float32.
    with np.errstate(over="ignore", invalid="ignore"):
        return BASES[base](data).astype(np.float32, copy=False)


class Oidn:
    """OIDN's images of one frame. The features are prefiltered once, unless they are clean.

    OIDN denoises the primal with all of its light, as in OIDN's training. Networks get this image minus OIDN's image of
    the layer ``caustic`` (light that gradients exclude). OIDN's image of ``caustic`` is added to the result of the
    network again. So caustics in the result are as sharp as in OIDN's image.

    OIDN's largest network denoises the primal: with a smaller network, ngpt-combine has 8 % more error. OIDN's smallest
    network denoises the base: a larger network changes the error of ngpt-combine by less than 1 % in rooms
    (docs/lab/log).
    """

    def __init__(self, data: Repaired):
        self._data = data

    @cached_property
    def of_primal(self) -> np.ndarray:
        """OIDN's image of the primal, (H, W, 3) float32, without direct emission and ``of_caustic``."""
        image = self._of_all_light
        return image if self._data.caustic is None else image - self.of_caustic

    @cached_property
    def of_caustic(self) -> np.ndarray:
        """The denoised ``caustic``, (H, W, 3) float32, to be added to a reconstruction of the data's ``image``."""
        light = self._data.caustic
        assert light is not None
        alone = replace(self._with_clean_features, image=light, direct=np.zeros_like(light), fine={})
        return caustic.given_back(oidn(alone, "clean", "high"), light)

    def of_base(self, base: np.ndarray) -> np.ndarray:
        """OIDN's image of a reconstruction, (H, W, 3) float32; both without direct emission."""
        # Beside edges, a base may be negative. Negative values are clamped to 0, or to the least value of the primal if
        # that is negative.
        least = min(float(self._data.image.min()), 0) - self._data.direct
        return oidn(replace(self._with_clean_features, image=np.maximum(base, least), fine={}), "clean", "fast")

    @property
    def _of_all_light(self) -> np.ndarray:
        data = self._with_clean_features
        if data.caustic is not None:
            data = replace(data, image=data.image + data.caustic)
        return of_both(data, "high")

    @cached_property
    def _with_clean_features(self) -> Repaired:
        if clean.features_are_clean(self._data):
            return self._data
        return with_clean_features(self._data)


def denoised(by_oidn: Oidn, base: np.ndarray | None, names: Collection[str]) -> dict[str, np.ndarray]:
    """The layers of ``DENOISED`` that are in ``names``, (H, W, 3), without direct emission.

    "denoised_base" is left out if ``base`` is None. Raises NgptError if OIDN is not installed.
    """
    images = {"denoised": by_oidn.of_primal} if "denoised" in names else {}
    if "denoised_base" in names and base is not None:
        images["denoised_base"] = by_oidn.of_base(base)
    return images


def _layer(name: str) -> str:
    """The layer of a stack that equals an input, or whose square root is the input."""
    return name.replace("_se", "_var")


def _standard_error(variance: np.ndarray) -> np.ndarray:
    # Where the camera sees an emitter, the variance is unknown. It counts as 0 there, because the other light of such a
    # pixel hardly matters.
    return np.sqrt(np.nan_to_num(np.maximum(variance, 0), nan=0, posinf=0))
