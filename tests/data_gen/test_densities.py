"""A material samples directions with the density that it tells others of them, from behind and below horizons too."""

import numpy as np
import pytest
from unbiased import gradient_tests, load, render_ours, render_references

MATERIALS = {
    "diffuse": {"type": "diffuse"},
    "black": {"type": "diffuse", "reflectance": 0.0},
    "metal": {"type": "roughconductor", "alpha": 0.4},
    "streaked": {"type": "roughconductor", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.4},
    "plastic": {"type": "plastic"},
    "matte plastic": {"type": "roughplastic", "alpha": 0.3},
    "frosted": {"type": "roughdielectric", "alpha": 0.3},
    "principled": {"type": "principled", "roughness": 0.5, "spec_trans": 0.5, "metallic": 0.3},
    "blend": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}},
    "two sides": {"type": "twosided", "nested": {"type": "roughconductor", "alpha": 0.3}},
    "bowed": {
        "type": "normalmap",
        "normalmap": {"type": "rgb", "value": [0.8, 0.5, 0.8]},
        "bsdf": {"type": "diffuse"},
    },
}
LANES = 1 << 14


def sampled(mi, material):
    """A vertex seen from all sides, its material, and samples with what was said of them: as they come."""
    import drjit as dr

    bsdf = mi.load_dict(material)
    numbers = np.random.default_rng(4).random((5, LANES), np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.t, si.sh_frame = mi.Float(1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(*numbers[:2]))
    sample, f_p = bsdf.sample(mi.BSDFContext(), si, mi.Float(numbers[2]), mi.Point2f(*numbers[3:]))
    return si, bsdf, sample, f_p


@pytest.mark.parametrize("name", MATERIALS)
def test_a_sampled_direction_has_the_density_that_others_are_told(renderer, name):
    from data_gen.paths.vertex import SMOOTH, consistent, evaluate, event_kind

    si, bsdf, sample, f_p = sampled(renderer, MATERIALS[name])
    before = np.array(sample.pdf)
    ours = np.array(consistent(bsdf, si, sample, f_p).pdf)
    told = np.array(evaluate(bsdf, si, sample.wo)[1])
    smooth = np.array(event_kind(sample.sampled_type)) == SMOOTH
    # At the very horizon rounding decides.
    assert np.mean((ours > 0) != (told > 0), where=smooth) < 1e-3
    # What has light, or could have for another colour, is left as it is.
    kept = (np.array(f_p).max(axis=0) > 0) | ~smooth | (told > 0)
    assert np.array_equal(ours[kept], before[kept])
    if name in ("diffuse", "black", "metal"):
        assert np.mean((before > 0) & (told == 0)) > 0.01  # the trap is there


def panels():
    """Four under a sky, two of them seen from behind, two of metal; before them a floor."""
    from data_gen.scenes.builtin import _camera, _diffuse, _path, _rgb, _wall

    metal = {"type": "roughconductor", "material": "Cu", "alpha": 0.4}
    kinds = [(bsdf, z) for bsdf in (_diffuse(0.8, 0.7, 0.6), metal) for z in (0.7, -0.7)]
    return {
        "type": "scene",
        "integrator": _path(4),
        "sensor": _camera([0, 1, 5], [0, 1, 0], 40),
        "sky": {"type": "constant", "radiance": _rgb(0.3, 0.4, 0.5)},
        "floor": _wall([0, 0, 0], [0, 1, 0], (8, 8), _diffuse(0.5, 0.5, 0.5)),
        **{f"panel{i}": _wall([i - 1.5, 1, 0], [0, 0.7, z], (1, 2), bsdf) for i, (bsdf, z) in enumerate(kinds)},
    }


def panel_tests(mi, sampler):
    """Over eight pixels, where another panel is."""
    scene = load(mi, panels, (24, 24))
    references = render_references(mi, scene, batches=12, spp=128)
    return gradient_tests(render_ours(scene, sampler, batches=12, spp=32, pixels=8), references, pixels=8)


@pytest.mark.parametrize("sampler", ["gpt", pytest.param("gpt-simple", marks=pytest.mark.slow)])
def test_unbiased_where_surfaces_are_seen_from_behind(renderer, sampler):
    for name, result in panel_tests(renderer, sampler):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["gpt", "gpt-simple"])
def test_a_mutant_that_takes_samples_at_their_word_fails_the_z_test(renderer, monkeypatch, sampler):
    from data_gen.paths import media
    from data_gen.samplers.teaching import gpt_simple

    for module in (media, gpt_simple):
        monkeypatch.setattr(module, "consistent", lambda bsdf, si, sample, *_: sample)
    passed = {name: result.passed for name, result in panel_tests(renderer, sampler)}
    assert passed["primal"] and not (passed["dx"] and passed["dy"]), passed
