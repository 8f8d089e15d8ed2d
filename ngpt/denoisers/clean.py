"""Whether albedo and normal have so little noise that OIDN does best to take them as they are."""

import numpy as np

from ngpt.repair import Repaired

# Features are clean enough to be taken as they are if their variance is at most this share of the primal's relative
# one. Their variance by itself does not decide: at 7e-4 prefiltering is worth a fifth of the error in simple scenes, as
# their images have little noise, and at 2e-3 nothing in rooms (docs/lab/log).
CLEAN = 0.003
# A share of the mean: light below its square root is dark, and its relative variance counts less.
DARK = 1e-3


def features_are_clean(data: Repaired) -> bool:
    """Whether the noise of albedo and normal is known and small compared with the image's, see ``CLEAN``."""
    if data.feature_noise is None or data.noise is None:
        return data.feature_noise == 0
    light = data.image.mean(axis=-1, dtype=np.float64)
    variance = np.nan_to_num(data.noise.mean(axis=-1, dtype=np.float64), posinf=0)
    relative = variance / (light**2 + DARK * light.mean() ** 2 + 1e-300)
    return data.feature_noise <= CLEAN * float(relative.mean())
