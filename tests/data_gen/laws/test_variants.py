"""Samplers in spectral and monochromatic variants: unbiased, or refused."""

import numpy as np
import pytest
from media_scenes import coloured_smoke, colours
from references import references
from registered import slow
from unbiased import assert_unbiased, load, render_ours

from data_gen.backend import use_variant
from data_gen.render import render_stack
from ngpt.errors import NgptError

SPECTRAL, MONO = "llvm_ad_spectral", "llvm_ad_mono"
# Variant, sampler, scene, size, over how many pixels. In monochromatic variants Dr.Jit does not find a number that the
# kernels of light paths use.
CASES = [
    slow(SPECTRAL, "gpt", "diffuse", (24, 24), 1),
    (SPECTRAL, "gpt", colours, (16, 16), 1),
    (MONO, "gpt", coloured_smoke, (16, 16), 4),
    *(slow(variant, sampler, "lens", (24, 24), 1) for variant in (SPECTRAL, MONO) for sampler in ("bdpt", "gbdpt")),
]


@pytest.fixture
def variant():
    """What changes to a variant; the usual one afterwards."""
    yield use_variant
    use_variant()


@pytest.mark.recorded_anew
@pytest.mark.parametrize(("name", "sampler", "scene", "size", "pixels"), CASES)
def test_unbiased(renderer, variant, name, sampler, scene, size, pixels):
    variant(name)
    expected = references(renderer, scene, size)
    expected = np.broadcast_to(expected, (*expected.shape[:3], 3))
    assert_unbiased(render_ours(load(renderer, scene, size), sampler, 12, 48, pixels), expected, pixels=pixels)


def test_photons_follow_no_spectra(renderer, variant):
    variant(SPECTRAL)
    for sampler in ("ppm", "vcm"):
        with pytest.raises(NgptError, match=f"'{sampler}'.*as variant 'llvm_ad_rgb' allows; use --sampler gpt"):
            render_stack(load(renderer, "diffuse", (8, 8)), 1, 0, sampler, unbiased=True)
    variant(MONO)
    assert render_stack(load(renderer, "diffuse", (8, 8)), 2, 0, "ppm", unbiased=True)["primal"].mean() > 0.01


def test_polarised_light_is_declined(renderer, variant):
    variant("llvm_ad_spectral_polarized")
    scene = load(renderer, "diffuse", (4, 4))
    with pytest.raises(NgptError, match="polarised"):
        render_stack(scene, 1, sampler="gpt", unbiased=True)
    with pytest.raises(NgptError, match="is polarised, which 'gpt' does not follow; use --sampler gpt-basic"):
        renderer.load_dict({"type": "gpt"}).render(scene, spp=1)
