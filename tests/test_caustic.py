"""The layer ``caustic``: taken out for methods that read gradients, left in for all others, and added back denoised."""

from dataclasses import replace

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.denoisers import caustic, diffusion
from ngpt.io.exr import read, write
from ngpt.io.openexr import read_exr
from ngpt.layers import FEATURE_NOISE, GATHERED
from ngpt.merging import merge
from ngpt.methods import METHODS, reconstruct
from ngpt.network.inputs import Oidn
from ngpt.network.shipped import WEIGHTS
from ngpt.repair import repair
from ngpt.sequence.history import Temporal
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, spread

SIZE = (20, 27)
SPARKS = np.s_[3:17:5, 2:25:6]


def with_caustic(stack, scale=1.0):
    """The stack with rare bright light in ``caustic``, which its primal holds too and its gradients do not."""
    light = np.zeros_like(stack["primal"])
    light[SPARKS] = scale * np.float32([40, 30, 20])
    return stack.replace(primal=stack["primal"] + light, caustic=light, caustic_var=light**2)


PLAIN = full_stack(*SIZE)
LIT = with_caustic(PLAIN)


def test_methods_with_gradients_work_on_what_gradients_are_differences_of():
    data, plain = repair(LIT), repair(PLAIN)
    assert np.allclose(data.image, plain.image, atol=1e-5)
    assert np.array_equal(data.noise, plain.noise) and np.array_equal(data.caustic, LIT["caustic"])


def test_other_methods_see_all_light_and_all_its_variance():
    data = repair(LIT, gradients=False)
    assert data.caustic is None and np.array_equal(data.image, LIT["primal"])
    assert np.array_equal(data.noise, LIT["primal_var"] + LIT["caustic_var"])
    assert np.array_equal(ngpt.denoise(LIT, "primal"), LIT["primal"])


@pytest.mark.parametrize("auxiliary", ["prefiltered", pytest.param("none", marks=pytest.mark.slow)])
def test_oidn_leaves_the_light_of_photons_to_the_diffusion(auxiliary):
    """Other methods see all light, and so does OIDN where no photons brought it."""
    pytest.importorskip("mitsuba_oidn")
    alone = {name: layer for name, layer in LIT.layers.items() if name not in ("dx", "dy", "dx_var", "dy_var")}
    photons = GradientStack(alone, {GATHERED: 1})
    plain = GradientStack({name: PLAIN[name] for name in alone if not name.startswith("caustic")})
    data = repair(photons)
    expected = ngpt.denoise(plain, "oidn", auxiliary=auxiliary) + caustic.of_photons(data)
    assert np.allclose(ngpt.denoise(photons, "oidn", auxiliary=auxiliary), expected, atol=1e-4)
    for method in ("primal", "nfor"):
        assert np.array_equal(ngpt.denoise(photons, method), ngpt.denoise(GradientStack(alone), method))
    whole = GradientStack({name: layer for name, layer in alone.items() if not name.startswith("caustic")})
    assert np.array_equal(ngpt.denoise(GradientStack(alone), "oidn"), ngpt.denoise(whole, "oidn"))


@pytest.mark.parametrize("marked", [(0, 1), (1, 0), (1, 1), (0, 0)])
def test_merged_photons_are_known_for_photons_wherever_they_come_from(marked):
    stacks = []
    for seed, (mark, light) in enumerate(zip(marked, (LIT["caustic"], 3 * LIT["caustic"]), strict=True)):
        known = {"ngpt:spp": 4, "ngpt:seed": str(seed), "ngpt:sampler": "vcm"} | ({GATHERED: 1} if mark else {})
        stacks.append(GradientStack({**LIT.layers, "caustic": light, "primal": PLAIN["primal"] + light}, known))
    merged = merge(stacks)
    assert merged.attributes.get(GATHERED) == (1 if any(marked) else None)
    assert np.allclose(merged["caustic"], 2 * LIT["caustic"], rtol=1e-5)
    assert np.allclose(merged["primal"], LIT["primal"] + LIT["caustic"], rtol=1e-5, atol=1e-6)
    assert np.allclose(repair(merged).image, repair(LIT).image, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("corrections", [None, "shipped"])
def test_photons_of_a_shot_are_neither_lost_nor_doubled(corrections):
    """Frames at rest: their results, each with its photons denoised apart, are blended with those before."""
    pytest.importorskip("mitsuba_oidn")
    rng, temporal = np.random.default_rng(5), Temporal(corrections)
    for frame in range(4):
        light = LIT["caustic"] * rng.uniform(0.5, 1.5, (*SIZE, 1)).astype(np.float32)
        known = {GATHERED: 1, "ngpt:frame": frame, "ngpt:previousFrame": frame - 1}
        layers = {"caustic": light, "primal": PLAIN["primal"] + light, "motion": np.zeros((*SIZE, 2), np.float32)}
        stack = GradientStack({**LIT.layers, **layers}, known)
        image = ngpt.denoise(stack, "oidn")
        blended = temporal.next(stack, image)
        assert blended.sum(dtype=np.float64) == pytest.approx(stack["primal"].sum(dtype=np.float64), rel=0.03)
        assert (temporal.share > 0.1) == (frame > 0)


@pytest.mark.parametrize("method", ["l2", "l1", "cv", "wcv", "wl2"])
def test_its_light_is_added_back_once(method):
    more = (ngpt.denoise(LIT, method).astype(np.float64) - ngpt.denoise(PLAIN, method)).sum()
    assert more == pytest.approx(LIT["caustic"].sum(dtype=np.float64), rel=0.03)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_repaired_and_counted(bad):
    light = LIT["caustic"].copy()
    light[8, 8, 1] = light[3, 2] = bad
    broken = LIT.replace(caustic=light, primal=LIT["primal"] + np.where(np.isfinite(light), 0, bad))
    for gradients in (False, True):
        data = repair(broken, gradients)
        assert data.pixels == 2 and np.isfinite(data.image).all()
    assert np.isfinite(data.caustic).all()
    assert np.isnan(data.caustic_var[8, 8]).all() and np.isnan(data.noise[8, 8]).all()
    result = reconstruct(broken, "wcv")
    assert result.repaired == 2 and result.untrusted == 8


def test_files_keep_it_in_full_precision(tmp_path):
    stack = with_caustic(PLAIN, scale=1e4)
    write(tmp_path / "stack.exr", stack)
    part = read_exr(tmp_path / "stack.exr").parts[0]
    assert {part.channels[f"{name}.R"].dtype for name in ("caustic", "caustic_var")} == {np.dtype(np.float32)}
    again = read(tmp_path / "stack.exr")
    write(tmp_path / "result.exr", ngpt.denoise(again, "wcv"), like=again)
    for held in (again, read(tmp_path / "result.exr")):
        assert all(np.array_equal(held[name], stack[name]) for name in ("primal", "caustic", "caustic_var"))


def test_merged_stacks_are_the_stack_of_all_samples(rng):
    """The variance of the primal is that of what is not in the layer, between stacks too."""
    samples = {"rest": 5 + rng.normal(size=(12, 5, 4, 3)), "caustic": rng.gamma(0.1, 10, (12, 5, 4, 3))}

    def stack(part, seed):
        n = len(samples["rest"][part])
        means = {name: values[part].mean(axis=0) for name, values in samples.items()}
        variances = {name: values[part].var(axis=0, ddof=1) / n for name, values in samples.items()}
        layers = {"primal": means["rest"] + means["caustic"], "caustic": means["caustic"]}
        layers |= {"primal_var": variances["rest"], "caustic_var": variances["caustic"]}
        return GradientStack.from_arrays(attributes={"ngpt:spp": n, "ngpt:seed": str(seed)}, **layers)

    merged, whole = merge([stack(np.s_[:4], 0), stack(np.s_[4:], 1)]), stack(np.s_[:], 2)
    for name in whole.names:
        assert np.allclose(merged[name], whole[name], rtol=1e-5, atol=1e-6), name


@pytest.mark.parametrize("method", ["ngpt-fast", "ngpt-combine", "ngpt-primal", "nfor", "oidn"])
def test_who_takes_it_out(method, monkeypatch):
    """Networks with gradients, by OIDN those that call it; a network of one's own by what its file says."""
    if METHODS[method].missing():
        pytest.skip(METHODS[method].missing())
    told = []
    monkeypatch.setattr(caustic, "denoised", lambda data: told.append("by diffusion") or data.caustic)
    monkeypatch.setattr(caustic, "given_back", lambda found, light: told.append("by OIDN") or light)
    expected = {"ngpt-fast": ["by diffusion"], "ngpt-combine": ["by OIDN"]}.get(method, [])
    ngpt.denoise(LIT, method)
    assert told == expected
    if "weights" in METHODS[method].options:
        ngpt.denoise(LIT, "ngpt", weights=str(WEIGHTS / f"{method}.onnx"))
        assert told == 2 * expected


def test_by_oidn_the_light_stays():
    pytest.importorskip("mitsuba_oidn")
    data = repair(with_caustic(full_stack(64, 80)))
    image = Oidn(data).of_caustic
    assert image.min() >= 0 and image.std() < 0.5 * data.caustic.std()
    assert image.sum(dtype=np.float64) == pytest.approx(data.caustic.sum(dtype=np.float64), rel=1e-3)


def test_light_that_is_no_noise_stays_where_it_is():
    edge = np.zeros((24, 30, 3), np.float32)
    edge[:, 15:] = 2
    data = repair(full_stack(24, 30).replace(primal=edge, caustic=edge, caustic_var=np.full_like(edge, 1e-4)))
    assert np.abs(caustic.denoised(data) - edge).max() < 0.02


def test_light_does_not_cross_from_surface_to_surface():
    stack = with_caustic(full_stack(40, 40))
    lit = stack["caustic"].copy()
    lit[:, 20:] = 0
    layers = {"albedo": np.full_like(lit, 0.5), "normal": np.zeros_like(lit), "depth": np.full((40, 40, 1), 3.0)}
    layers["normal"][:, :20, 2] = layers["normal"][:, 20:, 0] = 3
    image = caustic.denoised(repair(stack.replace(caustic=lit, caustic_var=lit**2, **layers)))
    assert image[:, 20:].sum() < 0.01 * image.sum()


def test_the_texture_under_photons_stays(rng):
    """Light that is the same everywhere, but for noise, on a floor of many colours."""
    size = (40, 50)
    albedo = rng.uniform(0.1, 0.8, (*size, 3)).astype(np.float32)
    light = (albedo * rng.uniform(0, 4, (*size, 1))).astype(np.float32)
    layers = {"albedo": albedo, "normal": np.zeros_like(albedo), "depth": np.full((*size, 1), 3.0)}
    data = repair(full_stack(*size).replace(primal=light, caustic=light, caustic_var=(2 * albedo) ** 2, **layers))

    def error(image):
        return np.square(image / (2 * albedo) - 1).mean()

    assert error(caustic.of_photons(data)) < 0.2 * error(caustic.denoised(data))
    assert caustic.of_photons(data).sum(dtype=np.float64) == pytest.approx(light.sum(dtype=np.float64), rel=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (2, 2), (3, 70)])
@pytest.mark.parametrize("scale", [1e-20, 1e18])
def test_any_size_and_brightness(size, scale):
    light = np.full((*size, 3), 3 * scale, np.float32)
    light[0, 0] = -scale
    stack = full_stack(*size).replace(caustic=light, caustic_var=np.full_like(light, np.inf))
    image = caustic.denoised(repair(stack))
    assert np.isfinite(image).all()
    assert image.sum(dtype=np.float64) == pytest.approx(light.sum(dtype=np.float64), rel=1e-4)


def test_the_diffusion_does_not_depend_on_how_many_pixels_are_worked_on_at_a_time(monkeypatch, rng):
    light = rng.gamma(0.3, 1, (3, 37, 12)).astype(np.float32)
    variance = rng.gamma(0.3, 0.1, (37, 12)).astype(np.float32)
    surfaces = 0.4 * rng.normal(size=(4, 37, 12)).astype(np.float32)
    expected = diffusion.diffused(light, variance, surfaces)
    monkeypatch.setattr(diffusion, "_PIXELS", 10)
    np.testing.assert_allclose(diffusion.diffused(light, variance, surfaces), expected, atol=1e-5 * expected.max())


def with_a_bright_disk(rng):
    """A stack whose ``caustic`` is a fifth of the light and ends sharply on a plain wall; its light, and all of it."""
    y, x = np.mgrid[:96, :128]
    rest = (0.6 + 0.3 * np.sin(x / 17) * np.cos(y / 23))[..., None] * np.float32([1, 0.9, 0.7])
    light = np.where((x - 70) ** 2 + (y - 50) ** 2 < 22**2, 1.0, 0)[..., None] * np.float32([0.9, 1, 1.1])
    light *= rest.sum() / light.sum() / 4
    # As of a few paths that find a lamp through glass.
    caustic = light * rng.gamma(0.5, 2, (*x.shape, 1))
    dx, dy = forward_differences(rest)
    layers = {"primal": rest * rng.gamma(8, 1 / 8, rest.shape) + caustic, "caustic": caustic}
    layers |= {"dx": dx + 0.02 * rng.normal(size=dx.shape), "dy": dy + 0.02 * rng.normal(size=dy.shape)}
    layers["dx"][:, -1] = layers["dy"][-1] = 0
    layers |= {"primal_var": rest**2 / 8, "dx_var": 4e-4 + 0 * dx, "dy_var": 4e-4 + 0 * dy, "caustic_var": 2 * light**2}
    layers |= {"albedo": 0.5 + 0 * rest, "normal": np.broadcast_to([0.0, 0, 1], rest.shape)}
    layers["depth"] = np.full((*x.shape, 1), 3.0)
    return GradientStack.from_arrays(attributes={FEATURE_NOISE: 0.0}, **layers), light, rest + light


def test_what_is_sharp_in_it_stays_sharp_beside_mirrors_and_glass(rng):
    """As sharp as by OIDN on it alone, and as bright."""
    pytest.importorskip("mitsuba_oidn")
    stack, light, clean = with_a_bright_disk(rng)
    assert light.sum() == pytest.approx(0.2 * clean.sum(), rel=1e-3)
    image, data = ngpt.denoise(stack, "ngpt-combine"), repair(stack)
    plain = {name: stack[name] for name in stack.names if not name.startswith("caustic")} | {"primal": data.image}
    rest = ngpt.denoise(GradientStack(plain, stack.attributes), "ngpt-combine")
    alone = rest + Oidn(data).of_caustic
    assert np.mean((image - clean) ** 2) < 1.1 * np.mean((alone - clean) ** 2)
    assert image.sum(dtype=np.float64) == pytest.approx(stack["primal"].sum(dtype=np.float64), rel=0.02)
    # Across the edge, from two pixels inside to two outside, and all along it.
    y, x = np.mgrid[:96, :128]
    radius = np.hypot(x - 70, y - 50)
    inside, outside = (image[np.abs(radius - 22 - beside) < 0.7].mean(axis=0) for beside in (-2, 2))
    assert (inside - outside > 0.85 * light[50, 70]).all()


def test_subpixels_hold_it_and_it_is_added_once(rng):
    """OIDN's image of subpixels includes this light, so it is taken out of that image too."""
    pytest.importorskip("mitsuba_oidn")
    stack, *_ = with_a_bright_disk(rng)
    fine = replace(stack, fine={name: spread(stack[name], 2) for name in FINE})
    light = stack["caustic"].mean()
    found = ngpt.denoise(fine, "ngpt-combine").mean() - ngpt.denoise(stack, "ngpt-combine").mean()
    assert light > 0.01 and abs(found) < 0.2 * light
