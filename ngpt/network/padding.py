"""Pads images and their gradients by reflection, to sizes that a U-Net accepts."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import pad as replicated

# The least padding in pixels on every side, so that borders look like the inside of an image [NGPT's code].
MARGIN = 8

Pads = tuple[int, int, int, int]


def pads(height: int, width: int, alignment: int, margin: int = MARGIN) -> Pads:
    """The padding (top, bottom, left, right): ``margin``, and at the bottom and right as much as alignment needs."""
    return (margin, margin + -(height + 2 * margin) % alignment, margin, margin + -(width + 2 * margin) % alignment)


def pad(layers: Mapping[str, Tensor], pads: Pads) -> dict[str, Tensor]:
    """The layers (..., H, W), padded by reflection; the border pixels themselves are not repeated.

    Layers whose names begin with dx or dy become the differences of the reflected image. So their sign is flipped in
    the reflection, except for layers without sign, whose names end with _se or _noise. The last column of dx (last row
    of dy), unused in the given layers, lies inside the padded image. It gets the reflected difference between the last
    two columns (rows). An image that is smaller than the padding is reflected back and forth.
    """
    height, width = next(iter(layers.values())).shape[-2:]
    device = next(iter(layers.values())).device
    rows, columns = _mirror(height, *pads[:2], device), _mirror(width, *pads[2:], device)
    padded = {}
    for name, layer in layers.items():
        signed = not name.endswith(("_se", "_noise"))
        if name.startswith("dx"):
            padded[name] = _differences(layer, columns, -1, signed).index_select(-2, rows[:-1])
        elif name.startswith("dy"):
            padded[name] = _differences(layer, rows, -2, signed).index_select(-1, columns[:-1])
        else:
            padded[name] = layer.index_select(-2, rows[:-1]).index_select(-1, columns[:-1])
    return padded


def crop(image: Tensor, pads: Pads) -> Tensor:
    """The image (..., H, W) without its padding. ``image`` is (..., H + top + bottom, W + left + right)."""
    top, bottom, left, right = pads
    return image[..., top : image.shape[-2] - bottom, left : image.shape[-1] - right]


def extended(image: Tensor, radius: int) -> Tensor:
    """A padded image (N, C, H, W) with ``radius`` more pixels on every side, which repeat its border.

    The added pixels influence only pixels that ``crop`` removes.
    """
    return replicated(image, 4 * (radius,), "replicate") if radius else image


def _mirror(size: int, before: int, after: int, device: torch.device) -> Tensor:
    """The index of the pixel at each of the positions -before .. size + after."""
    period = max(2 * (size - 1), 1)
    wave = torch.arange(-before, size + after + 1, device=device) % period
    return torch.where(wave < size, wave, period - wave)


def _differences(layer: Tensor, pixels: Tensor, axis: int, signed: bool) -> Tensor:
    """The differences (or their standard errors) between each of ``pixels`` and the next one."""
    here, there = pixels[:-1], pixels[1:]
    values = layer.index_select(axis, torch.minimum(here, there))
    # 1 or -1; 0 where the image is one pixel wide.
    step = (there - here).to(layer.dtype)
    step = step if signed else step.abs()
    return values * (step if axis == -1 else step[:, None])
