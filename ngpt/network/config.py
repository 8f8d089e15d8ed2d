"""The configuration of a network: the table [model] of a TOML file, which is also in the header of weights.

``ModelConfig`` holds the fields of this table, and makes the checks that all kinds of networks share. Each kind of
network has a ``Kind``, which makes further checks, and creates the network.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

from torch import nn

from ngpt.classical.bases import BASES
from ngpt.errors import NgptError
from ngpt.network import features, inputs, oidnet, padding, poisson
from ngpt.network.heads import Head, head_of
from ngpt.network.unet import POOLING, DenseUNet, PlainUNet
from ngpt.system.parts import Registry

# Limits on the numbers in a file. They allow far more than networks need, and far too little to exhaust a machine.
MAX_LEVELS, MAX_CHANNELS, MAX_UNITS = 8, 1024, 32
# Kernels must not reach beyond the padding.
MAX_KERNEL = 2 * padding.MARGIN + 1
MAX_SWEEPS = 64


@dataclass(frozen=True)
class ModelConfig:
    """The configuration of a reconstruction.

    ``network``   "dense" or "plain" (``ngpt.network.unet``), "oidn" (``ngpt.network.oidnet``), or a kind of network
                  from another package, whose documentation says how it uses the fields below
    ``channels``  for each level, finest first: the channels that each unit adds (dense), the width (plain), or the
                  channels of OIDN's small or default network (oidn)
    ``units``     for each level, the units on the way down, and again on the way up (dense); none for plain and oidn
    ``inputs``    the layers that the network reads, in order; names of ``ngpt.network.features.CHANNELS``
    ``base``      the classical method whose result is the layer "base"; "" for none
    ``start``     the images among the inputs that the network starts from: it predicts a weight for each of them in
                  each pixel, and corrects the logarithm of their mean. The default is the base. Without any image, the
                  network predicts the image itself, as NGPT does
    ``quiet``     the relative standard error of the primal, over 15x15 pixels, below which the result is blended with
                  the base. The blend is linear in the error and in the logarithm: as noise vanishes, the result
                  converges to the base, whatever the network predicts. Pixels whose variance is 0 or unknown are not
                  blended. 0: no pixels are blended
    ``kernel``    the side, in pixels, of the kernels that average the weighted mean of the images in ``start``
                  (``ngpt.network.heads.Pyramid``); odd. 0: the network weights and corrects each pixel by itself
    ``scales``    the number of resolutions that have kernels, each half as fine as the last; 1 without kernels
    ``demodulate``  whether the kernels average the image divided by the albedo, and the result is multiplied by it
                  again; needs the input albedo, and ``scales``
    ``sweeps``    the number of steps, at each of several resolutions, that draw the image toward the gradients with
                  predicted weights (``ngpt.network.poisson``); needs the inputs dx_noise and dy_noise. 0: none
    ``pooling``   how the network halves and doubles sizes: "convolution", as NGPT does, or by 1x1 convolutions and
                  "average", "maximum" or "bilinear" (``ngpt.network.unet``)
    """

    network: str
    channels: tuple[int, ...]
    units: tuple[int, ...]
    inputs: tuple[str, ...]
    base: str = ""
    start: tuple[str, ...] = ()
    quiet: float = 0.0
    kernel: int = 0
    scales: int = 1
    demodulate: bool = False
    sweeps: int = 0
    pooling: str = "convolution"

    def __post_init__(self) -> None:
        if not isinstance(self.network, str) or self.network not in KINDS:
            raise KINDS.unknown(str(self.network), KINDS, ", ".join(KINDS))
        if self.pooling not in POOLING:
            raise NgptError(f"pooling '{self.pooling}': choose one of: {', '.join(POOLING)}")
        if self.base and not self.start:
            object.__setattr__(self, "start", ("base",))
        for name in ("channels", "units", "inputs", "start"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in self.inputs:
            if name not in features.CHANNELS:
                raise NgptError(f"input '{name}' is unknown; inputs are: {', '.join(features.CHANNELS)}")
        if self.base not in ("", *BASES):
            raise NgptError(f"base '{self.base}': choose one of: {', '.join(BASES)}")
        self.kind.check(self)
        defaults = {field.name: field.default for field in fields(self) if field.default is not MISSING}
        others = [name for name in self.kind.goes_without if getattr(self, name) != defaults[name]]
        if others:
            raise NgptError(f"network '{self.network}' cannot be combined with {', '.join(others)}; leave it out")

    @property
    def kind(self) -> "Kind":
        return KINDS[self.network]

    @property
    def head(self) -> Head:
        """The head, which makes an image from the prediction of the network."""
        return self.kind.head(self)

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers that are inputs themselves, or from which inputs are computed.

        Each of these layers is in the stack, or ``ngpt.network.inputs`` makes it.
        """
        names = features.sources(self.inputs)
        # The exposure is computed from the primal.
        return names if "primal" in names else ("primal", *names)

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the layers that a stack must hold."""
        return inputs.needs(self.layers, self.base)

    @property
    def reads_gradients(self) -> bool:
        """Whether the network reads gradients. If so, its images exclude the layer ``caustic``, as gradients do."""
        return "dx" in self.needs

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class Kind(ABC):
    """A kind of network. ``goes_without`` are the fields of ``ModelConfig`` that it does not use."""

    goes_without: tuple[str, ...] = ()

    @abstractmethod
    def check(self, config: ModelConfig) -> None:
        """Raises NgptError for an invalid configuration of a network of this kind."""

    @abstractmethod
    def head(self, config: ModelConfig) -> Head:
        """See ``ModelConfig.head``."""

    @abstractmethod
    def network(self, config: ModelConfig) -> nn.Module:
        """An untrained network."""


class Plain(Kind):
    """``ngpt.network.unet.PlainUNet``, with any head."""

    has_units = False

    def check(self, config: ModelConfig) -> None:
        check_layers(config, self.has_units)
        levels = len(config.channels)
        if type(config.kernel) is not int or config.kernel not in (0, *range(3, MAX_KERNEL + 1, 2)):
            raise NgptError(f"kernel = {config.kernel!r}: must be an odd number of pixels from 3 to {MAX_KERNEL}, or 0")
        if config.kernel and not config.start:
            raise NgptError(f"kernel = {config.kernel}: there is no image to average; give a base, or start")
        if type(config.scales) is not int or not 1 <= config.scales <= levels:
            raise NgptError(f"scales = {config.scales!r}: must be from 1 to the {levels} levels of the network")
        if bool(config.kernel) != (config.scales > 1):
            raise NgptError(f"kernel = {config.kernel}, scales = {config.scales}: kernels need 2 scales or more")
        pyramid = config.scales > 1 and "albedo" in config.inputs
        if type(config.demodulate) is not bool or (config.demodulate and not pyramid):
            raise NgptError(f"demodulate = {config.demodulate!r}: true or false; needs scales and the input albedo")
        self._check_sweeps(config)
        if type(config.quiet) not in (int, float) or not 0 <= config.quiet < math.inf:
            raise NgptError(f"quiet = {config.quiet!r}: must be a finite relative standard error, 0 for none")
        if config.quiet and not {"base", "primal_se"} <= set(config.layers):
            raise NgptError(
                f"quiet = {config.quiet}: goes over to the base by the noise of the primal; give a base, and inputs "
                "that are made of it and of primal_se"
            )

    @staticmethod
    def _check_sweeps(config: ModelConfig) -> None:
        sweeps, levels = config.sweeps, len(config.channels)
        if type(sweeps) is not int or not 0 <= sweeps <= MAX_SWEEPS:
            raise NgptError(f"sweeps = {sweeps!r}: must be a whole number up to {MAX_SWEEPS}, 0 for none")
        if sweeps and not {"dx", *poisson.GRADIENTS[2:]} <= {*config.layers, *config.inputs}:
            raise NgptError(
                f"sweeps = {sweeps}: draw the image toward the gradients by their noise; needs the inputs "
                "dx_noise and dy_noise, and dx and dy or inputs that are made of them"
            )
        if sweeps and levels < poisson.SCALES:
            raise NgptError(f"sweeps = {sweeps}: are at {poisson.SCALES} resolutions; the network has {levels} levels")

    def head(self, config: ModelConfig) -> Head:
        head = head_of(config.start, config.kernel, config.scales, config.demodulate)
        return poisson.Poisson(config.start, head, config.sweeps) if config.sweeps else head

    def network(self, config: ModelConfig) -> nn.Module:
        channels = features.channels(config.inputs)
        return PlainUNet(channels, config.channels, **last_of(config), pooling=config.pooling)


class Dense(Plain):
    """``ngpt.network.unet.DenseUNet``."""

    has_units = True

    def network(self, config: ModelConfig) -> nn.Module:
        channels = features.channels(config.inputs)
        return DenseUNet(channels, config.channels, config.units, **last_of(config), pooling=config.pooling)


class Oidn(Kind):
    """``ngpt.network.oidnet.OidnUNet``. OIDN's transfer functions take the place of a head."""

    goes_without = ("quiet", "kernel", "scales", "demodulate", "sweeps", "pooling")

    def check(self, config: ModelConfig) -> None:
        colour = "base" if config.base else "primal"
        if config.inputs != (colour, *oidnet.FEATURES):
            raise NgptError(f"inputs {', '.join(config.inputs)}: of 'oidn' they must be {colour}, albedo, normal")
        if config.channels not in oidnet.SHAPES:
            shapes = " or ".join(str(list(shape)) for shape in oidnet.SHAPES)
            raise NgptError(f"channels {list(config.channels)}: of 'oidn' they must be {shapes}")
        if config.units:
            raise NgptError(f"units {list(config.units)}: 'oidn' has none; give []")

    def head(self, config: ModelConfig) -> Head:
        return head_of(config.start, 0, 1, False)

    def network(self, config: ModelConfig) -> nn.Module:
        return oidnet.OidnUNet(config.channels)


_OURS: dict[str, Kind] = {"dense": Dense(), "plain": Plain(), "oidn": Oidn()}
# Other packages register kinds of networks by entry points (docs/train/add-a-network.md).
KINDS: Registry[Kind] = Registry("ngpt.networks", "network", Kind, _OURS)


def check_layers(config: ModelConfig, units: bool) -> None:
    """Raises NgptError unless inputs, levels, base and start are valid; ``units``: whether the network has units."""
    names, levels = ", ".join(config.inputs), len(config.channels)
    if "primal" not in config.inputs or len(set(config.inputs)) < len(config.inputs):
        raise NgptError(f"inputs {names}: each once, and 'primal' among them")
    if not 1 <= levels <= MAX_LEVELS or not _whole(config.channels, MAX_CHANNELS):
        raise NgptError(
            f"channels {list(config.channels)}: give a positive number for each level, "
            f"up to {MAX_CHANNELS}, and at most {MAX_LEVELS} levels"
        )
    if units and (len(config.units) != levels or not _whole(config.units, MAX_UNITS)):
        raise NgptError(
            f"units {list(config.units)}: give a positive number, up to {MAX_UNITS}, for each of {levels} levels"
        )
    if bool(config.base) != ("base" in config.layers):
        raise NgptError(f"base is '{config.base}' while inputs are {names}: give both or none")
    if "denoised_base" in config.layers and not config.base:
        raise NgptError("input 'denoised_base' is the denoised base, and there is no base; set base")
    for name in config.start:
        if name not in features.IMAGES or name not in config.layers:
            raise NgptError(
                f"start '{name}': must be one of {', '.join(features.IMAGES)}, and an input or what one is made of"
            )


def last_of(config: ModelConfig) -> dict[str, Any]:
    """The arguments for ``ngpt.network.unet.LastConvolution`` that the head needs."""
    return {"outputs": config.head.outputs, "zero": config.head.neutral, "normalise": config.head.normalise}


def _whole(numbers: tuple[Any, ...], most: int) -> bool:
    return all(type(number) is int and 1 <= number <= most for number in numbers)
