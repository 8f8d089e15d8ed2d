"""The U-Net of Open Image Denoise, and OIDN's steps before and after it.

OIDN can run weights that are trained here, on all of its devices, in its tiles, and by its own tools
(``ngpt.network.tza``). In PyTorch the network gives the same pixels as in OIDN, so training optimises the images that
users get:

    exposure of the colour -> perceptual curve -> zeros up to multiples of 16 -> network -> inverse -> exposure

The inputs are colour, albedo in [0, 1] and normal in [-1, 1], three channels each. Negative colours count as 0.

[Intel Open Image Denoise 2.4.1: training/model.py, core/color.h, core/autoexposure.h, core/unet_filter.cpp]
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, pad, relu

# Channels of the encoder -> channels of the decoder, for OIDN's small and its default network.
SHAPES: dict[tuple[int, ...], tuple[int, ...]] = {
    (32, 32, 32, 32, 32): (64, 64, 64, 32, 32, 32),
    (32, 48, 64, 80, 96): (112, 96, 64, 64, 64, 32),
}
# The layers that the network reads in addition to the colour.
FEATURES = ("albedo", "normal")

# For the exposure, an image is divided into bins. KEY is the geometric mean of the luminances of bins after exposure,
# and BIN the approximate side of a bin in pixels. Bins with a luminance up to LEAST are left out.
KEY, BIN, LEAST = 0.18, 16, 1e-8
LUMINANCE = (0.212671, 0.715160, 0.072169)
# The curve from radiance y to its code x, in three pieces. The largest number in half precision has the code 1.
A, B, C, D = 1.41283765e03, 1.64593172, 4.31384981e-01, -2.94139609e-03
E, F, G = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01
Y0, Y1, X0, X1 = 1.57945760e-06, 3.22087631e-02, 2.23151711e-03, 3.70974749e-01
LARGEST = 65504.0


def perceptual(y: Tensor) -> Tensor:
    """The codes of radiance >= 0; the code of ``LARGEST`` is 1."""
    power = B * y.clamp(min=Y0) ** C + D
    curve = torch.where(y <= Y0, A * y, torch.where(y <= Y1, power, E * torch.log(y + F) + G))
    return curve / _code_of_largest()


def radiance(x: Tensor) -> Tensor:
    """The inverse of ``perceptual`` for codes >= 0."""
    x = x * _code_of_largest()
    power = ((x.clamp(min=X0) - D) / B) ** (1 / C)
    return torch.where(x <= X0, x / A, torch.where(x <= X1, power, torch.exp((x - G) / E) - F))


def _code_of_largest() -> float:
    return float(E * torch.log(torch.tensor(LARGEST + F, dtype=torch.float64)) + G)


def exposure(colour: Tensor) -> Tensor:
    """The factor (N, 1, 1, 1) by which radiance (N, 3, H, W) is multiplied; 1 for black images."""
    weights = torch.tensor(LUMINANCE, dtype=torch.float64, device=colour.device).reshape(3, 1, 1)
    means = (colour.clamp(min=0) * weights).sum(1)
    for axis in (1, 2):
        length = means.shape[axis]
        bins = -(-length // BIN)
        counts = torch.arange(bins + 1, device=colour.device).mul(length).div(bins, rounding_mode="floor").diff()
        bin_of = torch.arange(bins, device=colour.device).repeat_interleave(counts)
        shape = [bins if i == axis else n for i, n in enumerate(means.shape)]
        means = means.new_zeros(shape).index_add(axis, bin_of, means)
        means = means / (counts[:, None] if axis == 1 else counts)
    lit = means > LEAST
    logarithms = torch.where(lit, torch.log2(means.clamp(min=LEAST)), 0).sum((1, 2))
    count = lit.sum((1, 2))
    scale = torch.where(count > 0, KEY / torch.exp2(logarithms / count.clamp(min=1)), 1)
    return scale.to(colour.dtype).reshape(-1, 1, 1, 1)


class OidnUNet(nn.Module):
    """Maps inputs (N, 9, H, W) to codes (N, 3, H, W); negative codes count as 0. ``alignment`` divides H and W.

    ``channels`` is a key of ``SHAPES``. The untrained network returns the first three channels of its input, which hold
    the colour. Its layers have the names that OIDN expects.
    """

    alignment = 16
    radius = 87

    def __init__(self, channels: tuple[int, ...]):
        super().__init__()
        e1, e2, e3, e4, e5 = channels
        d4, d3, d2a, d2b, d1a, d1b = SHAPES[channels]
        self.enc_conv0 = _convolution(9, e1)
        self.enc_conv1 = _convolution(e1, e1)
        self.enc_conv2 = _convolution(e1, e2)
        self.enc_conv3 = _convolution(e2, e3)
        self.enc_conv4 = _convolution(e3, e4)
        self.enc_conv5a = _convolution(e4, e5)
        self.enc_conv5b = _convolution(e5, e5)
        self.dec_conv4a = _convolution(e5 + e3, d4)
        self.dec_conv4b = _convolution(d4, d4)
        self.dec_conv3a = _convolution(d4 + e2, d3)
        self.dec_conv3b = _convolution(d3, d3)
        self.dec_conv2a = _convolution(d3 + e1, d2a)
        self.dec_conv2b = _convolution(d2a, d2b)
        self.dec_conv1a = _convolution(d2b + 9, d1a)
        self.dec_conv1b = _convolution(d1a, d1b)
        self.dec_conv0 = _convolution(d1b, 3)
        self._pass_on_the_colour(d2b)

    def _pass_on_the_colour(self, before: int) -> None:
        """Makes the untrained network return the colour: each channel is passed on through a path of its own."""
        with torch.no_grad():
            self.dec_conv0.weight.zero_()
            for i in range(3):
                for convolution, source in ((self.dec_conv1a, before + i), (self.dec_conv1b, i), (self.dec_conv0, i)):
                    convolution.weight[i].zero_()
                    convolution.weight[i, source, 1, 1] = 1

    def forward(self, x: Tensor) -> Tensor:
        given = x
        x = relu(self.enc_conv0(x))
        half = x = max_pool2d(relu(self.enc_conv1(x)), 2)
        quarter = x = max_pool2d(relu(self.enc_conv2(x)), 2)
        eighth = x = max_pool2d(relu(self.enc_conv3(x)), 2)
        x = max_pool2d(relu(self.enc_conv4(x)), 2)
        x = relu(self.enc_conv5b(relu(self.enc_conv5a(x))))
        x = relu(self.dec_conv4b(relu(self.dec_conv4a(_doubled_beside(x, eighth)))))
        x = relu(self.dec_conv3b(relu(self.dec_conv3a(_doubled_beside(x, quarter)))))
        x = relu(self.dec_conv2b(relu(self.dec_conv2a(_doubled_beside(x, half)))))
        x = relu(self.dec_conv1b(relu(self.dec_conv1a(_doubled_beside(x, given)))))
        # Rounding codes to 16 bits would change radiance by some per cent.
        with torch.autocast(x.device.type, enabled=False):
            return self.dec_conv0(x.float())

    def image(self, colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """OIDN's image of the colour (N, 3, H, W), of any size, but clamped to the brightest value of the input."""
        height, width = colour.shape[-2:]
        scale = exposure(colour)
        given = [perceptual(colour.clamp(min=0) * scale), albedo.clamp(0, 1), normal.clamp(-1, 1) / 2 + 0.5]
        x = pad(torch.cat(given, 1), (0, -width % self.alignment, 0, -height % self.alignment))
        codes = self(x.contiguous(memory_format=torch.channels_last))[..., :height, :width]
        light = radiance(codes.clamp(min=0))
        if self.training:
            # Clamped codes have no gradient, so a network that makes all pixels black could never learn again.
            light = light - relu(-codes)
        largest = colour.amax((1, 2, 3), keepdim=True).clamp(min=0)
        return torch.minimum(light / scale, largest)


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
    assert convolution.bias is not None
    nn.init.zeros_(convolution.bias)
    return convolution


def _doubled_beside(x: Tensor, other: Tensor) -> Tensor:
    """``x`` at twice its size and ``other``, concatenated by channels."""
    return torch.cat([interpolate(x, scale_factor=2.0, mode="nearest"), other], 1)
