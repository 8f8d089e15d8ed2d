"""The random transforms of E-LPIPS: a distance that is averaged over them is hard to fool.

Both images of a comparison get the same transform. [Kettunen, Härkönen and Lehtinen 2019, "E-LPIPS: Robust Perceptual
Image Similarity via Random Transformation Ensembles", section 4; distributions as in their code.]
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

SCALES = 8
OFFSET = 7
# The least side of an image after downscaling. It is 64 in E-LPIPS, but our crops have only 114 pixels.
SMALLEST = 32
_PERMUTATIONS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


@dataclass(frozen=True)
class Transform:
    """One draw of the ensemble for a batch of N images; apply it to every image of a comparison.

    ``scale``, ``phase``  box average over scale x scale pixels, from this row and column on; the same for the batch
    ``offset``            (N, 2) rows and columns, 0 .. 7, that are cut from the top and left; the rest of 7 is cut from
                          the opposite side
    ``flip``              (N,) 0 none, 1 left to right, 2 top to bottom, 3 both
    ``transpose``         whether rows and columns are exchanged; the same for the batch
    ``order``             (N, 3) permutation of the channels
    ``factor``            (N, 3) factors of the channels, 0.2 .. 1
    """

    scale: int
    phase: tuple[int, int]
    offset: Tensor
    flip: Tensor
    transpose: bool
    order: Tensor
    factor: Tensor

    def __call__(self, images: Tensor) -> Tensor:
        """Images (N, 3, H, W) to smaller ones (N, 3, H', W'); differentiable."""
        if self.scale > 1:
            images = avg_pool2d(images[..., self.phase[0] :, self.phase[1] :], self.scale)
        height, width = (max(size - OFFSET, 1) for size in images.shape[-2:])
        if min(images.shape[-2:]) > OFFSET:
            images = torch.stack(
                [i[:, y : y + height, x : x + width] for i, (y, x) in zip(images, self.offset.tolist(), strict=True)]
            )
        axes = ((), (-1,), (-2,), (-2, -1))
        images = torch.stack([i.flip(axes[f]) for i, f in zip(images, self.flip.tolist(), strict=True)])
        if self.transpose:
            images = images.transpose(-1, -2)
        index = self.order[:, :, None, None].expand(-1, -1, *images.shape[-2:])
        return torch.gather(images, 1, index) * self.factor[:, :, None, None]


def draw(
    count: int, height: int, width: int, generator: torch.Generator, scales: int = SCALES, smallest: int = SMALLEST
) -> Transform:
    """A transform for a batch of ``count`` images of this size.

    Scale k has a probability in proportion to 1 / k², up to ``scales`` and as long as no side becomes smaller than
    ``smallest``. Flips, permutations and factors are stratified over the batch.
    """
    device = generator.device

    def integer(limit: int, shape: tuple[int, ...] = ()) -> Tensor:
        return torch.randint(limit, shape, generator=generator, device=device)

    allowed = [k for k in range(1, scales + 1) if k == 1 or min(height, width) // k >= smallest]
    weights = torch.tensor([1 / k**2 for k in allowed], device=device)
    scale = allowed[int(torch.multinomial(weights, 1, generator=generator))]
    order = torch.tensor(_PERMUTATIONS, device=device)[_stratified(6, count, generator)]
    # A Latin hypercube: in every channel one factor from each of ``count`` even strata.
    strata = torch.stack([torch.randperm(count, generator=generator, device=device) for _ in range(3)], 1)
    uniform = (strata + torch.rand(count, 3, generator=generator, device=device)) / count
    return Transform(
        scale,
        (int(integer(scale)), int(integer(scale))),
        integer(OFFSET + 1, (count, 2)),
        _stratified(4, count, generator),
        bool(integer(2)),
        order,
        0.2 + 0.8 * uniform,
    )


def _stratified(kinds: int, count: int, generator: torch.Generator) -> Tensor:
    """``count`` numbers of 0 .. kinds - 1 in random order; their frequencies differ by at most one."""
    device = generator.device
    # The start is random, so that all kinds are equally likely even if there are fewer images than kinds.
    start = torch.randint(kinds, (), generator=generator, device=device)
    kind = torch.randperm(kinds, generator=generator, device=device)[
        (start + torch.arange(count, device=device)) % kinds
    ]
    return kind[torch.randperm(count, generator=generator, device=device)]
