"""Gradient resampling: from runs of one scene a stack in which no spike of the primal is one of the gradients, too.

    primal of a pixel = mean over as many runs as there are, drawn with replacement; dx and dy of it likewise, apart

[Back, Yoon and Moon 2018, "Feature generation for adaptive gradient-domain path tracing", by what section 5.2 of the
survey says of it]
"""

from collections.abc import Sequence

import numpy as np

from ngpt.stack import GradientStack


def resampled(runs: Sequence[GradientStack], merged: GradientStack, seed: int = 0) -> GradientStack:
    """``merged``, the stack of all ``runs``, with primal, dx and dy drawn anew; variances stay, a little too small.

    The draw of a pixel's light is one for all parts of its primal, the layers ``direct`` and ``caustic`` included.
    """
    random = np.random.default_rng(seed)
    n = len(runs)
    layers = {}
    for names in (("primal", "direct", "caustic"), ("dx",), ("dy",)):
        # How often each run is drawn for each pixel, (runs, H, W, 1)
        draws = random.multinomial(n, np.full(n, 1 / n), (merged.height, merged.width))
        shares = np.moveaxis(draws, -1, 0)[..., None] / n
        for name in names:
            if name in merged:
                layers[name] = sum(share * run[name] for share, run in zip(shares, runs, strict=True)).astype(
                    np.float32
                )
    return merged.replace(**layers)
