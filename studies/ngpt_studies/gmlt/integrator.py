r"""Gradient-domain Metropolis light transport: small mutations of a path of ``gpt`` that has found light.

Each pass is an independent render. It traces one independent path, a candidate, for each camera sample, as ``gpt``
does. Then it runs Markov chains over the random numbers of such paths. Chains visit paths in proportion to their value.

    x        a path with its four offset paths; g(x) is its contribution to a layer
    f(x)     its value, from the luminance of its light and of its differences
    b        mean of f over all paths; b̂: over the candidates of a pass; b0: over the paths of a first look
    K        mutations for each candidate

    layer =  mean over candidates of g b0 / (b0 + K f)  +  sum over mutations, for each candidate, of g b̂ / (b0 + K f)

Both terms are weighted by the balance heuristic. Mutations find x K f(x) / b times as often as candidates do. So dim
light comes mainly from candidates, which are even, and bright light from chains. No path counts for more than
b̂ g / (f K), so there are no fireflies. b0 is the same in all passes, whatever they find, so that the two weights of a
path sum to one.

Chains begin at candidates that are chosen in proportion to f, and are scaled by b̂. So they are unbiased, however short
they are.

[Lehtinen et al. 2013, "Gradient-Domain Metropolis Light Transport"; Kelemen et al. 2002; Veach and Guibas 1997,
"Metropolis Light Transport", section 5.1; survey, section 6.2]
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.samplers import SAMPLERS
from ngpt_studies.gmlt.chains import Paths, run, value_of

# Mutations for each candidate, and candidates for each chain
MUTATIONS, CANDIDATES = 3, 256
# The least number of paths of the first look, and the seed of their random numbers, far from those that users choose
_LOOK, _LOOK_SEED = 1 << 14, 0x3E7820


class GMLT:
    """The passes of a render; the first one begins with a look at the scene, for b0."""

    def __init__(self, paths: Paths):
        self.paths = paths
        self.b0: mi.Float | None = None

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        if self.b0 is None:
            spp = -(-_LOOK // camera.pixels)
            _, _, _, f = self.candidates(CameraSamples(camera.sensor, _LOOK_SEED, spp))
            self.b0 = dr.opaque(mi.Float, np.array(f, np.float64).mean())
        layers, Le, inside, f = self.candidates(camera)
        # ------------------------ Chains -----------------------------
        # By NumPy: sums of floats in parallel have no fixed order, so their bits would differ between runs.
        sums = np.cumsum(np.array(f, np.float64))
        chains = max(1, len(sums) // CANDIDATES)
        steps = -(-MUTATIONS * len(sums) // chains)
        b, K = dr.opaque(mi.Float, sums[-1] / len(sums)), dr.opaque(mi.Float, chains * steps / len(sums))
        if sums[-1] > 0:
            start = mi.UInt32(chosen(sums, chains, camera))
            run(self.paths, camera, start, layers, f, film, steps=steps, scale=lambda f: b / (self.b0 + K * f))
        # ---------------------- Candidates ---------------------------
        share = dr.select(f > 0, self.b0 / (self.b0 + K * f), 1)
        for name, light in layers.items():
            film.put(name, light * share + (Le if name == "primal" else 0), inside.get(name, True))
        ray, _, _ = camera.rays()
        film.put("direct", Le)
        film.put_all(features(self.paths.scene, camera.sensor, camera.random.clone(), ray))

    def candidates(self, camera: CameraSamples):
        """For one path of each camera sample: layers, light seen directly, the neighbours on the film, and value."""
        layers, Le, inside = self.paths.trace(camera, camera.random.clone())
        f = value_of(layers)
        dr.eval(layers, Le, inside, f)
        return layers, Le, inside, f


def chosen(sums: np.ndarray, n: int, camera: CameraSamples) -> np.ndarray:
    """``n`` lanes, chosen in proportion to their values, whose running sums are ``sums``.

    Each lane is chosen as often as expected, up to one time more or less. The choice uses a random number that no path
    draws.
    """
    key = camera.random.at(mi.UInt32(0)).next_key()
    u = float(mi.sample_tea_float64(key, mi.UInt32(0))[0])
    return np.minimum(np.searchsorted(sums, (np.arange(n) + u) / n * sums[-1], side="right"), len(sums) - 1)


def make(scene: mi.Scene) -> SamplePass:
    gpt = SAMPLERS["gpt"].integrator(scene)
    return GMLT(Paths(gpt, scene, gpt.plan(scene)))
