"""The teaching twin of ``gpt`` is right for what it renders, and refuses the rest."""

import drjit as dr
import numpy as np
import pytest
from data_gen_scenes import courtyard, polished
from unbiased import load

from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission, sample_light
from data_gen.paths.mis import mis_weight
from data_gen.paths.vertex import evaluate
from data_gen.samplers import find


def test_random_replay_of_it_is_random_replay(renderer):
    """As a plugin that samples radiance, in place of Mitsuba's ``path``."""
    scene = load(renderer, courtyard, (12, 12))
    nested = {"type": "gpt_simple", "max_depth": 7, "rr_depth": 5}
    replay = renderer.load_dict({"type": "gpt_basic", "nested": nested})
    ours = np.array(renderer.render(scene, integrator=replay, spp=256))
    assert ours[..., replay.aov_names().index("dx.R")].any()
    assert ours[..., :3].mean() == pytest.approx(np.array(renderer.render(scene, spp=1024)).mean(), rel=0.05)


class Pairs:
    """The first two steps of base paths, shifted to a neighbouring pixel; and the same offset paths shifted back."""

    def __init__(self, mi, scene):
        from data_gen.samplers.teaching.gpt_simple import base_step, start, step_apart, step_joined

        self.mi, self.scene = mi, scene
        camera = CameraSamples(scene.sensors()[0], 5, 64)
        (ray, _, _), (other, _, inside) = camera.rays(), camera.rays((1, 0))
        one, random = mi.Spectrum(1), camera.random
        x = scene.ray_intersect(mi.Ray3f(ray))
        first = base_step(scene, random, x, one, x.is_valid() & inside)
        apart = start(scene, x.is_valid() & inside, other, one)
        joined = step_apart(scene, first, apart)
        second = base_step(scene, random, first.x1, first.β1, first.x1.is_valid())
        self.there = step_joined(second, joined)

        to = dr.select(first.x1.is_valid(), dr.normalize(first.x1.p - apart.y.p), x.to_world(first.wo))
        back = self.step(apart.y, one, first, apart.y.to_local(to), joined.y)
        joined_back = step_apart(scene, back, start(scene, apart.r > 0, ray, one))
        again = self.step(joined.y, back.β1, second, second.wo, second.x1)
        self.back, self.both = step_joined(again, joined_back), again.goes_on
        self.tried, self.r, self.r_back = first.goes_on & (apart.r > 0), joined.r, joined_back.r
        dr.eval(self.there, self.back, self.tried, self.r, self.r_back)

    def step(self, x, β, other, wo, x1):
        """A step as if base path sampling had gone along ``wo`` to ``x1``; the emitter's numbers are of ``other``."""
        from data_gen.samplers.teaching.gpt_simple import Step, reflected

        light = sample_light(self.scene, x, other.u_light, x.is_valid())
        f, p = evaluate(x.bsdf(), x, wo)
        goes_on = other.goes_on & (p > 0)
        β1 = dr.select(goes_on, β * f / p, 0)
        Le, p_light = emission(self.scene, x1, x, goes_on, goes_on)
        L_light, L_bsdf = reflected(light, x), Le * mis_weight(p, p_light)
        kind = other.smooth, other.hole
        return Step(x, β, other.u_light, light, L_light, wo, p, goes_on, β1, x1, Le, p_light, L_bsdf, *kind, other.hit)


@pytest.fixture(scope="module")
def pairs(renderer):
    return Pairs(renderer, load(renderer, courtyard, (32, 32)))


def test_a_pair_says_the_same_from_either_side(pairs):
    """Sampled from the other side the same two paths have 1 / r, so that w and w' add up to 1, and -Δ and -a."""
    shifted = np.array(pairs.tried & (pairs.r > 0))
    r, r_back = np.array(pairs.r)[shifted], np.array(pairs.r_back)[shifted]
    assert (r_back > 0).mean() > 0.999
    # Mitsuba's rays start a little off the surface, which shows where angles are flat or vertices close.
    assert (np.abs(r * r_back - 1) < 0.05).mean() > 0.98
    both = shifted & np.array(pairs.both)
    for there, back in zip(pairs.there, pairs.back, strict=True):
        there, back = np.array(there)[:, both], np.array(back)[:, both]
        off = np.abs(there + back) > 0.05 * np.abs(there) + 1e-3 * np.abs(there).mean()
        assert off.mean() < 0.02


def test_most_shifts_succeed(pairs):
    assert (np.array(pairs.r) > 0).sum() > 0.8 * np.array(pairs.tried).sum()  # measured: 0.88


def test_takes_what_is_rough_enough(renderer):
    assert callable(find("gpt-simple").made(load(renderer, lambda: polished(0.06), (8, 8))))
