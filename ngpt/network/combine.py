"""What a combiner is given of another denoiser: its image of the primal, and its image of a reconstruction.

OIDN sees no gradients, and removes what it takes for noise; control variates keep every gradient, and their noise.
OIDN's image of the control variates has less noise to remove, so that it errs elsewhere than its image of the primal. A
network that sees all three, and the gradients, tells in each pixel whom to believe [after Back et al. 2020, "Deep
Combiner for Independent and Correlated Pixel Estimates", with a denoiser's image of the correlated estimate for a
kernel].
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ngpt.denoisers.oidn import oidn, prefiltered
from ngpt.repair import Repaired

# Inputs of a network that are no layers of a stack, but made of them by another denoiser.
IMAGES = ("denoised", "denoised_base")


def images(data: Repaired, base: np.ndarray | None, names: Collection[str]) -> dict[str, np.ndarray]:
    """Those of "denoised" and "denoised_base" that are among ``names``, (H, W, 3) without direct emission.

    OIDN's images of the primal and of ``base``. Raises NgptError where OIDN is not installed.
    """
    sources = dict(zip(IMAGES, (data.image, base), strict=True))
    if not sources.keys() & set(names):
        return {}
    # Once for both images: this is most of the time.
    data = replace(data, features=data.features | prefiltered(data.features))
    return {
        name: oidn(replace(data, image=np.ascontiguousarray(image, np.float32)), "clean", "high")
        for name, image in sources.items()
        if name in names and image is not None
    }
