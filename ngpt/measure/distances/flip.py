"""FLIP on tensors: the difference that a viewer sees when flipping between two images.

It is differentiable, so networks can learn from it; ``ngpt.measure.flip.flip`` is the reference implementation, for
measurements.

    opponent space -> contrast sensitivity (a Gaussian for each channel) -> Lab -> HyAB distance, compressed: colour
    luminance -> edges and points, by derivatives of a Gaussian -> their difference: feature
    result = colour^(1 - feature)

[Andersson et al. 2020, "FLIP: A difference evaluator for alternating images"; the largest over exposures as Andersson
et al. 2021, "Visualizing errors in rendered high dynamic range images".] At 67 pixels per degree.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

PIXELS_PER_DEGREE = 67.0
# Contrast sensitivity of the achromatic, the red-green and the blue-yellow channel: (a, b) of each Gaussian [table 1].
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
# Width of edges in degrees; exponents of colour and feature; the knee of the remapping and where it is mapped to.
_EDGE, _COLOUR, _FEATURE, _KNEE, _MAPPED = 0.082, 0.7, 0.5, 0.4, 0.95
# Keeps the derivative of roots finite; it changes results by less than 0.001.
_SMALL = 1e-6

# Linear sRGB to XYZ under D65, and back.
_TO_XYZ = torch.tensor(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_TO_RGB = torch.linalg.inv(_TO_XYZ)
_WHITE = _TO_XYZ.sum(1)
# The coefficients of the ACES curve in HDR-FLIP: (a x² + b x) / (c x² + d x + e).
_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)


def flip(image: Tensor, reference: Tensor, exposures: tuple[float, ...]) -> Tensor:
    """Mean HDR-FLIP in [0, 1) of scene-linear images (N, 3, H, W): the largest over these factors of exposure."""
    errors = [ldr_flip(aces(factor * image), aces(factor * reference)) for factor in exposures]
    return torch.stack(errors).amax(0).mean()


def aces(image: Tensor) -> Tensor:
    """Scene-linear radiance to linear display values in [0, 1]."""
    x = image.clamp(min=0, max=1e6)
    a, b, c, d, e = _ACES
    return ((a * x * x + b * x) / (c * x * x + d * x + e)).clamp(0, 1)


def ldr_flip(image: Tensor, reference: Tensor) -> Tensor:
    """The map (N, 1, H, W) of images (N, 3, H, W), linear in [0, 1]."""
    a, b = _opponent(image), _opponent(reference)
    colour = _colour_difference(_perceived(a), _perceived(b))
    # The lightness of the opponent space, in [0, 1].
    feature = _feature_difference((a[:, :1] + 16) / 116, (b[:, :1] + 16) / 116)
    return (colour + _SMALL) ** (1 - feature)


def _opponent(rgb: Tensor) -> Tensor:
    """YCxCz of linear sRGB."""
    x, y, z = _mixed(_TO_XYZ / _WHITE[:, None], rgb).split(1, 1)
    return torch.cat([116 * y - 16, 500 * (x - y), 200 * (y - z)], 1)


def _perceived(opponent: Tensor) -> Tensor:
    """Lab, with chroma scaled by lightness [Hunt], of an image filtered by contrast sensitivity."""
    seen = torch.cat(
        [_filtered(channel, terms) for channel, terms in zip(opponent.split(1, 1), _SENSITIVITY, strict=True)], 1
    )
    y = (seen[:, :1] + 16) / 116
    xyz = torch.cat([seen[:, 1:2] / 500 + y, y, y - seen[:, 2:] / 200], 1)
    white = _WHITE.to(xyz).reshape(1, 3, 1, 1)
    rgb = _mixed(_TO_RGB, xyz * white).clamp(0, 1)
    xyz = _mixed(_TO_XYZ, rgb) / white
    knee = (6 / 29) ** 3
    cubic = torch.where(xyz > knee, xyz.clamp(min=knee) ** (1 / 3), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    fx, fy, fz = cubic.split(1, 1)
    lightness = 116 * fy - 16
    return torch.cat([lightness, 0.01 * lightness * 500 * (fx - fy), 0.01 * lightness * 200 * (fy - fz)], 1)


def _colour_difference(a: Tensor, b: Tensor) -> Tensor:
    """HyAB [Abasi et al. 2020], compressed to [0, 1]: errors up to 0.4 of the largest fill 0.95 of it."""
    difference = a - b
    chroma = (difference[:, 1:].square().sum(1, keepdim=True) + _SMALL).sqrt()
    distance = (difference[:, :1].abs() + chroma + _SMALL) ** _COLOUR
    largest = _largest()
    knee = _KNEE * largest
    above = _MAPPED + (distance - knee) / (largest - knee) * (1 - _MAPPED)
    return torch.where(distance < knee, distance * (_MAPPED / knee), above)


def _largest() -> float:
    """The distance between green and blue, the largest there is in sRGB."""
    plain = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[..., None, None]
    y = _opponent(plain)
    lightness = (y[:, :1] + 16) / 116
    xyz = torch.cat([y[:, 1:2] / 500 + lightness, lightness, lightness - y[:, 2:] / 200], 1)
    fx, fy, fz = (xyz ** (1 / 3)).split(1, 1)
    light = 116 * fy - 16
    green, blue = torch.cat([light, 5 * light * (fx - fy), 2 * light * (fy - fz)], 1)
    return float(((green - blue)[0].abs() + (green - blue)[1:].norm(dim=0)).squeeze() ** _COLOUR)


def _feature_difference(a: Tensor, b: Tensor) -> Tensor:
    """The larger difference in the strength of edges or of points between two images of lightness."""
    sigma = 0.5 * _EDGE * PIXELS_PER_DEGREE
    x = torch.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1, dtype=torch.float32)
    gauss = torch.exp(-x.square() / (2 * sigma**2))
    smooth = gauss / gauss.sum()
    slope, bend = -x * gauss, (x.square() / sigma**2 - 1) * gauss
    differences = []
    for kernel in (slope, bend):
        # The positive and the negative weights of the filter each sum to 1.
        kernel = torch.where(kernel > 0, kernel / kernel.clamp(min=0).sum(), kernel / -kernel.clamp(max=0).sum())
        strength = [_norm(_separable(image, kernel, smooth), _separable(image, smooth, kernel)) for image in (a, b)]
        differences.append((strength[0] - strength[1]).abs())
    return ((torch.maximum(*differences) + _SMALL) / math.sqrt(2)) ** _FEATURE


def _norm(x: Tensor, y: Tensor) -> Tensor:
    return (x.square() + y.square() + _SMALL**2).sqrt()


def _filtered(channel: Tensor, terms: tuple[tuple[float, float], ...]) -> Tensor:
    """One channel (N, 1, H, W) filtered by contrast sensitivity; each Gaussian is separable."""
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    degrees = torch.arange(-radius, radius + 1, dtype=torch.float32) / PIXELS_PER_DEGREE
    kernels = [torch.exp(-(math.pi**2) * degrees.square() / b) for _, b in terms]
    weights = [a * math.sqrt(math.pi / b) for a, b in terms]
    total = sum(w * float(k.sum()) ** 2 for w, k in zip(weights, kernels, strict=True))
    parts = [_separable(channel, k, k) * (w / total) for w, k in zip(weights, kernels, strict=True)]
    return torch.stack(parts).sum(0)


def _separable(image: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """(N, 1, H, W) filtered by a kernel along rows and one along columns; border pixels are repeated."""
    radius = len(across) // 2
    image = pad(image, 4 * (radius,), "replicate")
    image = conv2d(image, across.to(image).reshape(1, 1, 1, -1))
    return conv2d(image, down.to(image).reshape(1, 1, -1, 1))


def _mixed(matrix: Tensor, image: Tensor) -> Tensor:
    """The channels of (N, 3, H, W) multiplied by a matrix (3, 3)."""
    return torch.einsum("ij,njhw->nihw", matrix.to(image), image)
