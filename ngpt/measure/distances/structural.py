"""A structural distance that needs no trained weights: MS-SSIM and gradient magnitudes."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

# The weights of scales 1 to 5, from Wang et al. 2003. Scales that are too coarse for an image are left out, and the
# other weights are then scaled so that their sum is 1.
_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# The windows of SSIM are boxes at every third pixel. The random offsets of the ensemble cover the positions between.
_WINDOW, _STRIDE = 7, 3
_C1, _C2 = 0.01**2, 0.03**2
# Keeps the root of a gradient magnitude and its derivative finite where an image is flat [GMSD, 0.17 % of the range].
_C3 = 0.0026


def structural_distance(a: Tensor, b: Tensor) -> Tensor:
    """The distance of images (N, 3, H, W) in [0, 1], display-encoded: 0 only for equal images, at most 2. float32.

        Σ_s w_s (1 - CS_s)  +  w_5 (1 - L_5)  +  Σ_s w_s mean (1 - GMS_s)

    CS_s is the contrast-structure of SSIM at scale s, and L_5 its luminance at the coarsest scale [Wang et al. 2003,
    eq. 7]. There, the parts are multiplied. Here, their distances are added, because a product has no gradient where
    one factor is 0. GMS_s is the similarity of gradient magnitudes at scale s [Xue et al. 2014, eq. 4]. w_s are the
    weights of the scales.
    """
    a, b = a.float(), b.float()
    weights = _weights(a)
    total = a.new_zeros(())
    for scale, weight in enumerate(weights):
        if scale:
            a, b = avg_pool2d(a, 2), avg_pool2d(b, 2)
        luminance, structure = ssim_parts(a, b)
        total = total + weight * ((1 - structure).mean() + (1 - gradient_similarity(a, b)).mean())
    return total + weights[-1] * (1 - luminance).mean()


def _weights(image: Tensor) -> Tensor:
    """The weights of the scales that are large enough for a window; their sum is 1."""
    scales = 1
    while scales < len(_WEIGHTS) and min(image.shape[-2:]) >> scales >= _WINDOW:
        scales += 1
    weights = torch.tensor(_WEIGHTS[:scales], device=image.device)
    return weights / weights.sum()


def ssim_parts(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Luminance and contrast-structure of SSIM in windows of 7x7 pixels, every third, range 1 [Wang et al. 2004].

    Smaller images are one window. The images' common mean is subtracted before squaring: in float32, E[x²] - E[x]² of
    bright flat images would be mostly rounding error.
    """
    window = min(_WINDOW, a.shape[-2]), min(_WINDOW, a.shape[-1])
    center = (a.mean((-2, -1), keepdim=True) + b.mean((-2, -1), keepdim=True)).detach() / 2
    x, y = a - center, b - center
    ex, ey, exx, eyy, exy = (avg_pool2d(image, window, _STRIDE) for image in (x, y, x * x, y * y, x * y))
    mean_a, mean_b = ex + center, ey + center
    # Rounding may leave a variance slightly below 0.
    var_a, var_b, covariance = (exx - ex * ex).clamp(min=0), (eyy - ey * ey).clamp(min=0), exy - ex * ey
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
    return luminance, (2 * covariance + _C2) / (var_a + var_b + _C2)


def gradient_similarity(a: Tensor, b: Tensor) -> Tensor:
    """The similarity of gradient magnitudes per pixel, (0, 1], by central differences; 1 where there are none."""
    if min(a.shape[-2:]) < 3:
        return torch.ones_like(a)
    ma, mb = (_squared_gradient(image) for image in (a, b))
    # The product of the magnitudes, as the root of a product, which needs one root less.
    product = torch.sqrt((ma + _C3) * (mb + _C3)) - _C3
    return (2 * product + _C3) / (ma + mb + _C3)


def _squared_gradient(image: Tensor) -> Tensor:
    x = (image[..., 1:-1, 2:] - image[..., 1:-1, :-2]) / 2
    y = (image[..., 2:, 1:-1] - image[..., :-2, 1:-1]) / 2
    return x * x + y * y
