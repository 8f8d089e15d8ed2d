"""The laws of every registered sampler, and a toy that shows what it takes to add one.

A sampler of the registry is unbiased, says how noisy it is, gives the same bits however it was rendered, and stays
within the memory it was given.
"""

from functools import cache

import numpy as np
import pytest
from data_gen_scenes import fog, leaf
from unbiased import DISTANCES, gradient_tests, load, render_ours, render_references

from data_gen.budget import Budget
from data_gen.samplers import SAMPLERS, Option, Sampler, choose, find, register
from ngpt.errors import NgptError
from ngpt.testing import z_test

LAYERS = ("primal", "dx", "dy")


class Toy:
    """Random replay in batches: the samples of a pixel in a pass are all one and the same, and a share is splatted."""

    def __init__(self, scene, share):
        from data_gen.samplers.common import radiance

        find("gpt-basic").made(scene)  # refuses what it cannot render
        self.scene, self.estimate, self.share = scene, radiance(scene, scene.integrator()), share

    def __call__(self, camera, film):
        import drjit as dr
        import mitsuba as mi

        from data_gen.film import SHIFTS
        from data_gen.paths.features import features

        def radiance(shift=(0, 0)):
            ray, importance, inside = camera.rays(shift)
            L = self.estimate(camera.random.clone(), ray, None, inside) * importance
            dr.eval(L, inside)  # or each gather would trace the paths anew
            first = dr.arange(mi.UInt32, dr.width(camera.pixel)) // camera.block * camera.block
            return dr.gather(mi.Color3f, L, first), dr.gather(mi.Bool, inside, first)

        L, _ = radiance()
        values = {"primal": (L, mi.Bool(True))}
        for name, shift in SHIFTS.items():
            L_shifted, inside = radiance(shift)
            values[name] = (L_shifted - L, inside)
        for name, (value, active) in values.items():
            film.put(name, value * (1 - self.share), active)
            film.splat(name, camera.pixel, value * self.share, active)
        film.put_all(features(self.scene, camera.sensor, camera.random.clone(), camera.rays()[0]))


TOY = Sampler(
    "toy",
    "a toy",
    make=Toy,
    refuses=lambda facts: "" if facts.integrator in ("path", "volpath") else "toys know only 'path' and 'volpath'",
    notes=lambda facts: [f"a note on {facts.integrator}"],
    options={"share": Option(0.5, "of each value that is splatted", range=(0, 1))},
    rank=5,
    batch=8,
)


@pytest.fixture(autouse=True)
def toy():
    """One registration, undone after each test."""
    register(TOY)
    yield
    del SAMPLERS["toy"]


EVERY = SAMPLERS | {"toy": TOY}


def cases(dear=lambda entry: entry.batch, of=lambda entry: True):
    """(name, whether the law runs at full length) of every sampler that it is a law ``of``.

    Short for those that are ``dear``, since their passes take long to start, and at full length in the slow suite.
    Studies run there alone, as the toy does, whose laws are those of a film with splats.
    """
    found = []
    for name, entry in EVERY.items():
        if not of(entry):
            continue
        apart = entry.standing == "study" or name == "toy"
        if not apart:
            found.append(pytest.param(name, not dear(entry), id=name))
        if apart or dear(entry):
            found.append(pytest.param(name, True, id=f"{name}-long", marks=pytest.mark.slow))
    return found


def passes_of(name, few, many):
    """So many samples per pixel as are ``few`` passes of a sampler with batches, and ``many`` samples of another."""
    return few * SAMPLERS[name].batch or many


def quick(renderer, name):
    """A quick scene that the sampler can render."""
    for description in ("diffuse", "glossy", fog):
        if not SAMPLERS[name].refuses(facts_of(renderer, description)):
            return description
    raise AssertionError(f"no scene here for sampler '{name}': add one")


def facts_of(renderer, description):
    from data_gen.scenes.facts import scene_facts

    return scene_facts(load(renderer, description, (4, 4)))


def scene_for(renderer, name, size):
    return load(renderer, quick(renderer, name), size)


def same(a, b):
    assert a.names == b.names
    for name in a.names:
        assert np.array_equal(a[name], b[name], equal_nan=True), name


@cache
def references_of(mi, description, size):
    """Of a scene that several tests render."""
    return render_references(mi, load(mi, description, size), spp=128)


def unbiased(entry):
    """Not those that say they are biased: their own tests hold them to what they converge to."""
    return not entry.biased


def with_each(cases, *values, unless=lambda entry, full, value: False):
    """The cases with each of the values, but for those that are nothing to be tested."""
    return [
        pytest.param(*case.values, value, id=f"{case.id}-{value}", marks=case.marks)
        for value in values
        for case in cases
        if not unless(EVERY[case.values[0]], case.values[1], value)
    ]


@pytest.mark.parametrize(
    ("name", "full", "pixels"),
    with_each(cases(of=unbiased), *DISTANCES, unless=lambda entry, full, pixels: pixels > 1 and not entry.gradients),
)
def test_unbiased(renderer, name, full, pixels):
    """Over one pixel, and over eight, where wrong densities and weights stand out of the noise."""
    description = quick(renderer, name)
    references = references_of(renderer, description, (32, 32))
    assert references.mean() > 0.01  # black images agree all too well
    stacks = render_ours(load(renderer, description, (32, 32)), name, spp=64 if full else 16, pixels=pixels)
    assert ("dx" in stacks[0]) == SAMPLERS[name].gradients
    for layer, result in gradient_tests(stacks, references, pixels=pixels):
        assert result.passed, f"{layer}: {result}"


# Quick ones; the slow suite has all.
POINTS = [
    pytest.param(
        name,
        points,
        id=f"{name}-{points}",
        marks=()
        if (name, points) in {("primal", "sobol"), ("gpt", "sobol"), ("gbdpt", "sobol"), ("primal", "rounds")}
        else pytest.mark.slow,
    )
    for points, names in (("sobol", SAMPLERS), ("rounds", ("primal", "gpt")))
    for name in names
    if "points" in SAMPLERS[name].options
]


@pytest.mark.parametrize(("name", "points"), POINTS)
def test_points_change_noise_alone(renderer, name, points):
    """The mean stays, and blocks of pixels have no more noise: dimensions that hang together would add some."""
    scene, found = scene_for(renderer, name, (24, 24)), []
    for kind, first in ((points, 0), ("independent", 100)):
        stacks = render_ours(scene, name, batches=16, spp=16, seed=first, points=kind)
        found.append({layer: np.stack([stack[layer] for stack in stacks]) for layer in LAYERS if layer in stacks[0]})
    ratios = []
    for layer in found[0]:
        ours, independent = (images[layer] for images in found)
        result = z_test(ours, independent, level=0.01 / len(found[0]))
        assert result.passed, f"{layer}: {result}"
        ratios.append(block_variances(ours) / block_variances(independent))
    # Of 16 seeds each, the variance of nine blocks in three colours is known to some 15 %, more of three layers.
    assert np.exp(np.mean(np.log(ratios))) < 1.15


def block_variances(images, side=8):
    """Geometric mean of the variances of block means over (n, H, W, C)."""
    n, height, width, channels = images.shape
    means = images.reshape(n, height // side, side, width // side, side, channels).mean(axis=(2, 4), dtype=np.float64)
    variances = means.var(axis=0, ddof=1).sum(axis=-1)
    return np.exp(np.log(variances[variances > 0]).mean())


@pytest.mark.parametrize(("name", "full"), cases(of=unbiased))
def test_unbiased_where_there_are_holes_and_no_environment(renderer, name, full):
    """Where Mitsuba's ``path`` loses light (docs/use/rendering.md), and no sampler of ours may."""
    scene, references = load(renderer, leaf, (32, 32)), references_of(renderer, leaf, (32, 32))
    for pixels in DISTANCES:
        try:
            stacks = render_ours(scene, name, *(16, 32) if full else (8, 16), pixels=pixels)
        except NgptError as error:
            pytest.skip(f"it refuses holes: {error}")
        for layer, result in gradient_tests(stacks, references, pixels=pixels):
            assert result.passed, f"{layer} over {pixels} pixels: {result}"


def gains(renderer, name, full=True):
    """Variance of differences of independent pixels over that of dx and dy: in the mean, and in the median pixel."""
    from ngpt.evaluation.gradientmap import variances_of_differences
    from ngpt.stack import GradientStack

    spp = (16 if SAMPLERS[name].batch == 1 else 256) if full else passes_of(name, 8, 64)
    # In a ball there are few photons, and often none.
    options = {"photons": 8} if name == "gvpm" else {}
    layers = render_ours(
        load(renderer, quick(renderer, name), (48, 48)), name, batches=1, spp=spp, points="independent", **options
    )[0]
    found = []
    for layer, pixels in zip(("dx", "dy"), variances_of_differences(GradientStack.from_arrays(**layers)), strict=True):
        pixels, ours = pixels.sum(axis=-1), layers[f"{layer}_var"].sum(axis=-1)
        known = np.isfinite(pixels) & (pixels > 0) & (ours > 0)
        assert known.mean() > 0.5
        found.append((pixels[known].sum() / ours[known].sum(), np.median(pixels[known] / ours[known])))
    return found


# What gradients must gain on a quick scene, in the mean and in the median pixel. Those of gpt-basic are 5.0 and 6.8.
FLOORS = (2.5, 4.0)
# The share of the shifts that may fail there, of samplers that count them.
FAILURES = 0.25


# The toy's samples of a pass are all one.
@pytest.mark.parametrize(("name", "full"), cases(of=lambda entry: entry.gradients and entry.name != "toy"))
def test_gradients_have_less_noise_than_pixels(renderer, name, full):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    for layer, found in zip(("dx", "dy"), gains(renderer, name, full), strict=True):
        assert all(np.greater(found, FLOORS)), f"{layer}: {found}"
    if SAMPLERS[name].diagnoses:
        from data_gen.render import render_stack
        from ngpt.io.exr import pass_through

        stack = render_stack(scene_for(renderer, name, (32, 24)), 16 if full else 4, 0, name, diagnostics=True)
        assert pass_through(stack)["diagnostics.shiftFailures"].mean() < FAILURES


def test_a_sampler_that_rejects_every_shift_falls_through_the_floor(renderer, monkeypatch):
    """And passes the z-tests."""
    from data_gen.paths import shift

    monkeypatch.setattr(shift, "reconnects", lambda kind, *_: kind != kind)
    stacks = render_ours(load(renderer, "diffuse", (32, 32)), "gpt")
    for layer, result in gradient_tests(stacks, references_of(renderer, "diffuse", (32, 32))):
        assert result.passed, f"{layer}: {result}"
    assert not any(np.greater(found, FLOORS).any() for found in gains(renderer, "gpt"))


@pytest.mark.parametrize(("name", "full"), cases(dear=lambda entry: True))
def test_variances_are_those_over_seeds(renderer, name, full):
    """The law that every weight of a reconstruction rests on; of nets of points, see ``test_points``."""
    from data_gen.passes import render_passes

    scene, entry = scene_for(renderer, name, (24, 16)), SAMPLERS[name]
    # Where a sample is a pass, few of them: passes of one sample take long to start.
    spp = (6 if entry.batch == 1 else 16) if full else passes_of(name, 3, 16)
    sample, sensor, more = entry.made(scene), scene.sensors()[0], {"lane_bytes": entry.lane_bytes, "batch": entry.batch}
    more["points"] = "independent"
    stacks = [render_passes(sample, sensor, seed, Budget(spp), **more).develop() for seed in range(64 if full else 24)]
    low, high = (0.88, 1.12) if full else (0.8, 1.25)
    for layer in ("primal", "dx", "dy"):
        if layer in stacks[0]:
            over_seeds = np.var([stack[layer] for stack in stacks], axis=0, ddof=1, dtype=np.float64)
            told = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
            # Half of it may lie in a few pixels, at the edge of a lamp, where 64 seeds tell little.
            most = np.argsort((over_seeds + told).ravel())[: int(0.98 * told.size)]
            ratio = told.ravel()[most].mean() / over_seeds.ravel()[most].mean()
            # Passes of a biased sampler drift, which counts as noise.
            assert low < ratio < high + 0.2 * entry.biased, (layer, ratio)


# Those that are dear render the larger image in the slow suite.
@pytest.mark.parametrize(
    ("name", "full", "size"),
    with_each(cases(), (16, 12), (7, 5), unless=lambda entry, full, size: not full and size == (16, 12)),
)
def test_the_same_seed_gives_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, full, size):
    from data_gen import passes
    from data_gen.render import render_stack

    scene = scene_for(renderer, name, size)
    # Passes of one sample take long to start.
    spp = (20 if SAMPLERS[name].batch == 1 else 150) if full else 3 * SAMPLERS[name].batch + 1
    whole = render_stack(scene, spp, 7, name)
    same(whole, render_stack(scene, spp, 7, name))
    calls = []
    monkeypatch.setattr(passes, "FIRST_LANES", size[0] * size[1] * 40)
    monkeypatch.setattr(passes, "PASS_SECONDS", 1e-9)
    parts = render_stack(scene, spp, 7, name, lambda done, total: calls.append((done, total)))
    if SAMPLERS[name].batch:
        assert len(calls) == 1 + -(-spp // SAMPLERS[name].batch)
    else:
        # 40 samples are two blocks of 16; what is left over at the end is a pass of its own.
        assert calls == [(n, 150) for n in (0, 32, 48, 64, 80, 96, 112, 128, 144, 150)]
    same(whole, parts)
    assert not np.array_equal(whole["primal"], render_stack(scene, spp, 8, name)["primal"])


@pytest.mark.parametrize(("name", "full"), cases())
def test_memory_stays_within_its_budget(renderer, name, full):
    import drjit as dr

    from data_gen.render import render_stack

    scene = scene_for(renderer, name, (64, 48))
    spp = (8 if SAMPLERS[name].batch == 1 else 100) if full else 5 * SAMPLERS[name].batch
    # Photons with copies along rays, and whole paths that are recorded as one function, need more for any pass at all.
    memory = 60 if SAMPLERS[name].batch == 1 or name == "gpt-basic" else 40
    whole = render_stack(scene, spp, 1, name)
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    calls = []
    stack = render_stack(scene, spp, 1, name, lambda *call: calls.append(call), memory=memory)
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before < memory * 2**20
    assert len(calls) > 5
    same(whole, stack)


def test_a_toy_is_found_by_all_that_ask(renderer, capsys, tmp_path):
    import ngpt
    from data_gen.dataset.config import read_config
    from data_gen.dataset.crops import render_input
    from data_gen.inspect import inspect_scene
    from data_gen.render import render_stack
    from data_gen.scenes.facts import Facts
    from ngpt.cli import main

    with pytest.raises(SystemExit):
        main(["render", "--help"])
    assert "toy" in capsys.readouterr().out
    assert main(["info"]) == 0 and "a toy" in capsys.readouterr().out
    assert main(["info", "toy"]) == 0
    assert "of each value that is splatted (a number from 0 to 1; default 0.5)" in capsys.readouterr().out
    # gpt, to which media are invisible where 'path' renders them, leaves this scene to the next in rank.
    assert choose(Facts("path", ("air",))) == ("toy", find_reason("gpt", Facts("path", ("air",))))
    assert choose(Facts("volpath", ("air",)))[0] == "gpt"
    assert choose(Facts("path", ()))[0] == "gpt"
    assert choose(Facts("spectral", ()))[0] == "gpt-basic"
    plan = inspect_scene("diffuse")["plan"]
    assert not any("toy" in line for line in plan)  # it can, and is not chosen
    with pytest.raises(NgptError, match=r"toys know only 'path' and 'volpath'; use --sampler gpt-basic"):
        find("toy", Facts("spectral", ()))
    scene = scene_for(renderer, "toy", (6, 4))
    with pytest.raises(NgptError, match="sampler 'toy' has no option 'loud'; it has: share"):
        render_stack(scene, 1, sampler="toy", loud=True)
    with pytest.raises(NgptError, match="sampler 'toy' always renders features; only 'primal'"):
        render_stack(scene, 1, sampler="toy", with_features=False)
    target = tmp_path / "toy.exr"
    line = ["render", "diffuse", "--size", "6x4", "--spp", "4", "--sampler", "toy", "-o", str(target)]
    assert main([*line, "-O", "share=1.5"]) == 2
    assert "option 'share': '1.5' is not allowed; it takes a number from 0 to 1" in capsys.readouterr().err
    assert main([*line, "-O", "share=0.25"]) == 0
    by_command, by_python = ngpt.read(target), render_stack(scene, 4, sampler="toy", share=0.25)
    assert by_command.attributes["ngpt:sampler"] == "toy"
    assert by_command.attributes["ngpt:samplerOptions"] == by_python.attributes["ngpt:samplerOptions"] == "share=0.25"
    same(by_command, by_python)
    (tmp_path / "data.toml").write_text("scenes = 1\nsampler = 'toy'\n[samplers.toy]\nshare = 0.25\n")
    by_config = render_input(read_config(tmp_path / "data.toml"), scene, 4, 0, False)
    assert by_config.attributes["ngpt:samplerOptions"] == "share=0.25"
    same(by_config, by_python)


def test_a_toy_is_compared_at_equal_time(renderer, tmp_path, monkeypatch):
    from data_gen import service
    from data_gen.choosing import costs
    from ngpt.evaluation.config import Config
    from ngpt.evaluation.run import evaluate
    from ngpt.system.console import Console

    config = Config(
        scenes=("diffuse",),
        size=(16, 12),
        spp=(64,),
        seeds=1,
        methods=("wcv",),
        metrics=("relMSE",),
        primary="relMSE",
        samplers=("auto", "toy"),
        reference_spp=256,
        timing_spp=16,
        timing_repeats=1,
    )

    def timed(scene, options, spp, seed, clock):
        """A sample of the toy takes 3 s, one of the others 2 s."""
        return costs.render_stack(scene, spp, seed, **options), spp * (3.0 if options["sampler"] == "toy" else 2.0)

    monkeypatch.setattr(costs, "timed", timed)
    rows = {cell["method"]: cell for cell in evaluate(config, tmp_path, Console(quiet=True), "", service)["cells"]}
    assert rows.keys() == {"wcv (auto)", "wcv (toy)"} and not any(row["absent"] for row in rows.values())
    # The toy, whose samples cost more, gets fewer in the time, by whole batches.
    assert rows["wcv (auto)"]["spp used"] == 64
    assert abs(rows["wcv (toy)"]["spp used"] - 64 * 2 / 3) <= TOY.batch / 2


def find_reason(name, facts):
    return SAMPLERS[name].refuses(facts)
