"""Glass that disperses, differences between wavelengths, and the solve along them."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unbiased import load

from data_gen.backend import use_variant
from ngpt.errors import NgptError
from ngpt.testing import z_test
from ngpt_studies.spectral.glass import index, register

SIZE = (24, 16)


@pytest.fixture
def spectral(renderer):
    """The names of the study, in a spectral variant of Mitsuba with its glass; the usual variant afterwards."""
    use_variant("llvm_ad_spectral")
    from ngpt_studies.spectral import glass, render

    register()
    yield SimpleNamespace(**vars(render), prism=glass.prism)
    use_variant()


def test_indices_are_those_of_catalogues():
    """At the lines of Fraunhofer F, d, C; from which Abbe's number, the dispersion."""
    lines = np.array([486.13, 587.56, 656.27])
    for material, n, abbe in (("n-bk7", 1.5168, 64.17), ("n-sf11", 1.7847, 25.68)):
        found = index(material, lines)
        assert found[1] == pytest.approx(n, abs=1e-4)
        assert (found[1] - 1) / (found[0] - found[2]) == pytest.approx(abbe, rel=0.003)


def test_at_one_wavelength_it_is_a_dielectric(spectral):
    """Sample by sample, from either side, with Mitsuba's own of the same index."""
    rng = np.random.default_rng(0)
    ours = mi.load_dict({"type": "dispersive", "material": "n-sf11"})
    theirs = mi.load_dict({"type": "dielectric", "int_ior": float(index("n-sf11", 500.0)), "ext_ior": 1.0})
    si = dr.zeros(mi.SurfaceInteraction3f, 1000)
    direction = rng.standard_normal((3, 1000))
    si.wi = mi.Vector3f(direction / np.linalg.norm(direction, axis=0))
    si.wavelengths = mi.Spectrum(500)
    for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
        context, u = mi.BSDFContext(mode), mi.Float(rng.random(1000))
        (a, weight_a), (b, weight_b) = (bsdf.sample(context, si, u, mi.Point2f(0.5)) for bsdf in (ours, theirs))
        assert np.allclose(a.wo, b.wo, atol=1e-5) and np.allclose(weight_a, weight_b, rtol=1e-4)
        assert np.allclose(a.pdf, b.pdf, atol=1e-5) and np.allclose(a.eta, b.eta, rtol=1e-5)
        assert np.array_equal(a.sampled_type, b.sampled_type)
    bent = []
    for wavelength in (450, 650):
        si.wavelengths = mi.Spectrum(wavelength)
        bent.append(np.array(ours.sample(mi.BSDFContext(), si, u, mi.Point2f(0.5))[0].wo))
    assert np.abs(bent[0] - bent[1]).max() > 0.01


def test_steps_are_the_differences_of_bins(spectral):
    """Their mean against that of independent renders, and their variance against that over seeds."""
    scene = load(mi, spectral.prism(), SIZE)
    found = [spectral.render_spectra(scene, 6, 8, seed) for seed in range(12)]
    others = [spectral.render_spectra(scene, 6, 8, seed, steps=False) for seed in range(100, 112)]
    assert others[0].step is None and not found[0].step[..., -1].any()
    ours = np.stack([f.step[..., :-1] for f in found])
    theirs = np.stack([np.diff(o.light, axis=-1) for o in others])
    for b in (0, 2, 4):
        result = z_test(ours[..., b : b + 1].repeat(3, -1), theirs[..., b : b + 1].repeat(3, -1))
        assert result.passed, f"{b}: {result}"
    told = np.mean([f.step_var[..., :-1] for f in found])
    assert told == pytest.approx(np.mean(np.var(ours, axis=0, ddof=1)), rel=0.25)
    # Steps have a fraction of the noise of what they are the differences of.
    assert told < 0.2 * 2 * np.mean([f.light_var for f in found])
    assert np.array_equal(spectral.render_spectra(scene, 6, 8, 0).step, found[0].step)


def test_the_solve_is_that_of_the_normal_equations(rng, spectral):
    light, step = rng.random((1, 1, 7)), rng.random((1, 1, 7))
    spectra = spectral.Spectra(light, np.full((1, 1, 7), 0.5), step, np.full((1, 1, 7), 0.125))
    D = np.diff(np.eye(7), axis=0)
    expected = np.linalg.solve(np.eye(7) + 4 * D.T @ D, light[0, 0] + 4 * D.T @ step[0, 0, :-1])
    found = spectral.reconstructed(spectra)
    assert np.allclose(found[0, 0], expected) and found.sum() == pytest.approx(light.sum())
    brighter = spectral.Spectra(8 * light, np.full((1, 1, 7), 32.0), 8 * step, np.full((1, 1, 7), 8.0))
    assert np.allclose(spectral.reconstructed(brighter), 8 * found)
    exact = spectral.Spectra(light, np.zeros_like(light), np.append(np.diff(light), [[[0]]], -1), np.zeros_like(light))
    assert np.allclose(spectral.reconstructed(exact), light)
    assert spectral.reconstructed(spectral.Spectra(light, light, None, None)) is light


def test_colours_are_those_of_mitsuba(spectral):
    """White is white, and a render by bins has the colours of one by Mitsuba."""
    description = spectral.prism()
    for name in ("prism", "ball"):
        del description[name]
    scene = load(mi, description, SIZE)
    spectra = spectral.render_spectra(scene, 16, 16, steps=False)
    ours, theirs = spectral.to_rgb(spectra.light, spectra.edges), np.array(mi.render(scene, spp=512))
    assert np.allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.03)


def test_refusals(spectral):
    scene = load(mi, spectral.prism(), SIZE)
    with pytest.raises(NgptError, match="1 bins and 4 samples: at least 2 of each"):
        spectral.render_spectra(scene, 1, 4)
    with pytest.raises(Exception, match="unknown material 'ice'; choose one of: n-bk7, n-sf11"):
        mi.load_dict({"type": "dispersive", "material": "ice"})
    use_variant("llvm_ad_rgb")
    with pytest.raises(NgptError, match="variant 'llvm_ad_rgb' has no spectra to render; use 'llvm_ad_spectral'"):
        spectral.render_spectra(None, 4, 4)
