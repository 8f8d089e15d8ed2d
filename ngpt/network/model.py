"""A neural reconstruction as a whole: its configuration, the network, and what is around it."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from ngpt.classical.bases import BASES
from ngpt.errors import NgptError
from ngpt.network import features, inputs, kpcn, oidnet, padding, poisson
from ngpt.network.heads import Head, head_of
from ngpt.network.poisson import Poisson
from ngpt.network.transfer import signed_exp, signed_log
from ngpt.network.unet import POOLING, DenseUNet, PlainUNet

NETWORKS = ("dense", "plain", "kpcn", "oidn")
# What a file may ask for: far more than networks have, far less than takes down a machine.
MAX_LEVELS, MAX_CHANNELS, MAX_UNITS = 8, 1024, 32
# Kernels reach no further than the padding.
MAX_KERNEL = 2 * padding.MARGIN + 1
MAX_SWEEPS = 64
# Of ``quiet``: the side of the window, in pixels, over which noise is averaged, since the variance of one pixel knows
# too little; what is added to radiance before noise is divided by it; the largest number whose square is no overflow.
WINDOW, DARK, HUGE = 15, 0.01, 1e15


@dataclass(frozen=True)
class ModelConfig:
    """What a reconstruction is made of.

    ``network``   "dense" or "plain", see ``ngpt.network.unet``, "kpcn", see ``ngpt.network.kpcn``, or "oidn", see
                  ``ngpt.network.oidnet``
    ``channels``  for each level, finest first: what each unit adds (dense), the width (plain, and kpcn, of one level),
                  those of OIDN's small or default network (oidn)
    ``units``     for each level, units on the way down and again on the way up (dense), or 5x5 convolutions (kpcn);
                  none for plain and oidn
    ``inputs``    the layers it reads, in order; names of ``ngpt.network.features.CHANNELS``
    ``base``      the classical method whose result is its layer "base"; "" for none
    ``start``     the images among its inputs that it starts from: it predicts a weight for each of them in each pixel,
                  and corrects their mean in the logarithm. By default the base; without any it predicts the image
                  itself, as NGPT does
    ``quiet``     the relative standard error of the primal, over 15x15 pixels, below which the result goes over to the
                  base, in proportion and in the logarithm: as noise vanishes it converges with the base, whatever the
                  network says. Where the variance is 0, or not known, it does not. 0: nowhere
    ``kernel``    the side, in pixels, of the kernels by which it averages those images instead, see
                  ``ngpt.network.heads``; odd. 0: it weighs and corrects them pixel by pixel. Of
                  kpcn those of both parts of the light
    ``scales``    at how many resolutions there are kernels, each half as fine as the last; from 2 on of the
                  weighted mean of these images
    ``demodulate``  whether these average the image over the albedo, and multiply by it again; needs the input albedo,
                  and ``scales``
    ``sweeps``    at each of several resolutions, steps that draw the image toward the gradients, by weights that the
                  network predicts, see ``ngpt.network.poisson``; needs the inputs dx_noise and dy_noise. 0: none
    ``pooling``   how the network halves and doubles sizes: "convolution", as NGPT does, or by 1x1 convolutions and
                  "average", "maximum" or "bilinear", see ``ngpt.network.unet``
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
        if self.network not in NETWORKS:
            raise NgptError(f"network '{self.network}': choose one of: {', '.join(NETWORKS)}")
        if self.pooling not in POOLING:
            raise NgptError(f"pooling '{self.pooling}': choose one of: {', '.join(POOLING)}")
        if self.base and not self.start:
            object.__setattr__(self, "start", ("base",))
        for name in ("channels", "units", "inputs", "start"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in self.inputs:
            if name not in features.CHANNELS:
                raise NgptError(f"input '{name}' is unknown; inputs are: {', '.join(features.CHANNELS)}")
        if self.network == "oidn":
            self._check_oidn()
            return
        if "primal" not in self.inputs or len(set(self.inputs)) < len(self.inputs):
            raise NgptError(f"inputs {', '.join(self.inputs)}: each once, and 'primal' among them")
        levels = len(self.channels)
        if not 1 <= levels <= MAX_LEVELS or not _whole(self.channels, MAX_CHANNELS):
            raise NgptError(
                f"channels {list(self.channels)}: give a positive number for each level, "
                f"up to {MAX_CHANNELS}, and at most {MAX_LEVELS} levels"
            )
        if self.network != "plain" and (len(self.units) != levels or not _whole(self.units, MAX_UNITS)):
            raise NgptError(
                f"units {list(self.units)}: give a positive number, up to {MAX_UNITS}, for each of {levels} levels"
            )
        if self.base and self.base not in BASES:
            raise NgptError(f"base '{self.base}': choose one of: {', '.join(BASES)}")
        if bool(self.base) != ("base" in self.layers):
            raise NgptError(f"base is '{self.base}' while inputs are {', '.join(self.inputs)}: give both or none")
        if "denoised_base" in self.layers and not self.base:
            raise NgptError("input 'denoised_base' is the denoised base, and there is no base; set base")
        for name in self.start:
            if name not in features.IMAGES or name not in self.layers:
                raise NgptError(
                    f"start '{name}': must be one of {', '.join(features.IMAGES)}, and an input or what one is made of"
                )
        if self.network == "kpcn":
            self._check_kpcn()
            return
        if type(self.kernel) is not int or self.kernel not in (0, *range(1, MAX_KERNEL + 1, 2)):
            raise NgptError(f"kernel = {self.kernel!r}: must be an odd number of pixels up to {MAX_KERNEL}, or 0")
        if self.kernel and not self.start:
            raise NgptError(f"kernel = {self.kernel}: there is no image to average; give a base, or start")
        if type(self.scales) is not int or not 1 <= self.scales <= levels:
            raise NgptError(f"scales = {self.scales!r}: must be from 1 to the {levels} levels of the network")
        if self.scales > 1 and self.kernel < 3:
            raise NgptError(f"scales = {self.scales}: needs kernels of 3 pixels or more")
        if type(self.demodulate) is not bool or (self.demodulate and (self.scales < 2 or "albedo" not in self.inputs)):
            raise NgptError(f"demodulate = {self.demodulate!r}: true or false; needs scales and the input albedo")
        if type(self.sweeps) is not int or not 0 <= self.sweeps <= MAX_SWEEPS:
            raise NgptError(f"sweeps = {self.sweeps!r}: must be a whole number up to {MAX_SWEEPS}, 0 for none")
        if self.sweeps and not {"dx", *poisson.GRADIENTS[2:]} <= {*self.layers, *self.inputs}:
            raise NgptError(
                f"sweeps = {self.sweeps}: draw the image toward the gradients by their noise; needs the inputs "
                "dx_noise and dy_noise, and dx and dy or inputs that are made of them"
            )
        if self.sweeps and levels < poisson.SCALES:
            raise NgptError(
                f"sweeps = {self.sweeps}: are at {poisson.SCALES} resolutions; the network has {levels} levels"
            )
        if not isinstance(self.quiet, int | float) or isinstance(self.quiet, bool) or not 0 <= self.quiet < math.inf:
            raise NgptError(f"quiet = {self.quiet!r}: must be a finite relative standard error, 0 for none")
        if self.quiet and not {"base", "primal_se"} <= set(self.layers):
            raise NgptError(
                f"quiet = {self.quiet}: goes over to the base by the noise of the primal; give a base, and inputs that "
                "are made of it and of primal_se"
            )

    def _check_kpcn(self) -> None:
        if missing := [name for name in kpcn.NEEDED if name not in self.inputs]:
            raise NgptError(f"network 'kpcn' needs the inputs {', '.join(kpcn.NEEDED)}; lacks {', '.join(missing)}")
        if type(self.kernel) is not int or self.kernel not in range(3, kpcn.MAX_KERNEL + 1, 2):
            raise NgptError(f"kernel = {self.kernel!r}: of 'kpcn' it must be an odd number from 3 to {kpcn.MAX_KERNEL}")
        if len(self.channels) > 1:
            raise NgptError(f"channels {list(self.channels)}: 'kpcn' has one level; give one number")
        self._goes_without("kernel")

    def _check_oidn(self) -> None:
        colour = "base" if self.base else "primal"
        if self.inputs != (colour, *oidnet.FEATURES):
            raise NgptError(f"inputs {', '.join(self.inputs)}: of 'oidn' they must be {colour}, albedo, normal")
        if self.base not in ("", *BASES):
            raise NgptError(f"base '{self.base}': choose one of: {', '.join(BASES)}")
        if self.channels not in oidnet.SHAPES:
            shapes = " or ".join(str(list(shape)) for shape in oidnet.SHAPES)
            raise NgptError(f"channels {list(self.channels)}: of 'oidn' they must be {shapes}")
        if self.units:
            raise NgptError(f"units {list(self.units)}: 'oidn' has none; give []")
        self._goes_without("base", "start")

    def _goes_without(self, *but: str) -> None:
        """Raises NgptError where a field is set that is not one of these."""
        defaults = {field.name: field.default for field in fields(self) if field.default is not MISSING}
        others = [name for name, value in defaults.items() if name not in but and getattr(self, name) != value]
        if others:
            raise NgptError(f"network '{self.network}' goes without {', '.join(others)}: leave it out")

    @property
    def head(self) -> Head:
        """What makes an image of the network's prediction."""
        if self.network == "kpcn":
            return kpcn.SplitKernels(size=self.kernel)
        head = head_of(self.start, self.kernel, self.scales, self.demodulate)
        return Poisson(self.start, head, self.sweeps) if self.sweeps else head

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers its inputs are, or are computed of: of a stack, or made of one (``ngpt.network.inputs``)."""
        names = features.sources(self.inputs)
        # Exposure is that of the primal.
        return names if "primal" in names else ("primal", *names)

    @property
    def needs(self) -> tuple[str, ...]:
        """The layers a stack must hold, by the names of the contract."""
        return inputs.needs(self.layers, self.base)

    @property
    def reads_gradients(self) -> bool:
        """Whether it works on the light that gradients are the differences of; see ``ngpt.repair``."""
        return "dx" in self.needs

    def to_dict(self) -> dict[str, Any]:
        """The fields as TOML and JSON have them."""
        return asdict(self)


def _whole(numbers: tuple[Any, ...], most: int) -> bool:
    return all(type(number) is int and 1 <= number <= most for number in numbers)


class Reconstructor(nn.Module):
    """Layers (N, C, H, W), scene-linear, to the image (N, 3, H, W), scene-linear.

        exposure, depth scale -> padding -> channels -> network -> head -> (quiet) -> crop -> bounds -> exp -> exposure

    Any H and W. Proportional to the exposure: what goes in ``k`` times as bright comes out ``k`` times as bright. The
    result is bounded by the range of the primal, and 0. Layers hold finite values; see ``ModelConfig.inputs``.

    A network of OIDN's shape has what OIDN does around it instead (``ngpt.network.oidnet``).
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        channels, head = features.channels(config.inputs), config.head
        last: dict[str, Any] = {"outputs": head.outputs, "zero": head.neutral, "normalise": head.normalise}
        self.network: Any
        if config.network == "dense":
            self.network = DenseUNet(channels, config.channels, config.units, **last, pooling=config.pooling)
        elif config.network == "plain":
            self.network = PlainUNet(channels, config.channels, **last, pooling=config.pooling)
        elif config.network == "oidn":
            self.network = oidnet.OidnUNet(config.channels)
        else:
            self.network = kpcn.KPCN(config.inputs, config.channels[0], config.units[0], **last)

    @property
    def alignment(self) -> int:
        """What both sides of the padded image are divisible by."""
        return self.network.alignment

    @property
    def radius(self) -> int:
        """How far, in pixels, an input's influence on the image reaches, beside exposure, depth scale and bounds."""
        head = self.config.head
        # Kernels alone move pixels; pyramids and sweeps move what the network says of them, too.
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
        """The signed log of the image, unbounded, from layers normalised, completed and padded; float32."""
        if self.config.network == "oidn":
            return signed_log(self.network.image(*(scaled[name] for name in self.config.inputs)))
        # Channels last is the layout convolutions are fastest in, by half on CPUs.
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
        """How much the network's result counts beside the base, (N, 1, H, W) in [0, 1], by ``ModelConfig.quiet``."""
        noise, light = scaled["primal_se"].clamp(max=HUGE).square(), scaled["base"].abs().clamp(max=HUGE)
        both = torch.cat([layer.mean(1, keepdim=True) for layer in (noise, light)], 1)
        variance, mean = avg_pool2d(both, WINDOW, 1, WINDOW // 2, count_include_pad=False).split(1, 1)
        share = (variance.sqrt() / (self.config.quiet * (mean + DARK))).clamp(max=1)
        # None at all is what is not known, or a light that no sample has met yet.
        return torch.where(variance > 0, share, 1)

    @staticmethod
    def bounds(primal: Tensor) -> tuple[Tensor, Tensor]:
        """The least and the largest logarithm that images of such a primal (N, 3, H, W) may have, (N, 1, 1, 1)."""
        low, high = torch.aminmax(primal.flatten(1), dim=1)
        low, high = low.clamp(max=0), high.clamp(min=0)
        return signed_log(low).reshape(-1, 1, 1, 1), signed_log(high).reshape(-1, 1, 1, 1)


def parameters(module: nn.Module) -> int:
    """The number of trainable numbers."""
    return sum(p.numel() for p in module.parameters())
