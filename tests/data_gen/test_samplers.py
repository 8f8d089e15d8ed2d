"""The laws of every registered sampler, and a toy that shows what it takes to add one.

A sampler of the registry is unbiased, says how noisy it is, gives the same bits however it was rendered, and stays
within the memory it was given.
"""

import numpy as np
import pytest
from data_gen_scenes import fog
from unbiased import gradient_tests, load, render_ours, render_references

from data_gen.samplers import SAMPLERS, Sampler, choose, find, register
from ngpt.errors import NgptError


class Toy:
    """Random replay in batches: the samples of a pixel in a pass are all the same one, and half of it is splatted."""

    def __init__(self, scene, shy=False):
        from data_gen.samplers.gpt_basic import make

        make(scene)  # refuses what it cannot render
        self.scene, self.integrator = scene, scene.integrator()

    def __call__(self, camera, film):
        import drjit as dr
        import mitsuba as mi

        from data_gen.film import SHIFTS
        from data_gen.paths.features import features

        def radiance(shift=(0, 0)):
            ray, importance, inside = camera.rays(shift)
            L = self.integrator.sample(self.scene, camera.random.clone(), ray, None, inside)[0] * importance
            dr.eval(L, inside)  # or each gather would trace the paths anew
            first = dr.arange(mi.UInt32, dr.width(camera.pixel)) // camera.block * camera.block
            return dr.gather(mi.Color3f, L, first), dr.gather(mi.Bool, inside, first)

        L, _ = radiance()
        values = {"primal": (L, mi.Bool(True))}
        for name, shift in SHIFTS.items():
            L_shifted, inside = radiance(shift)
            values[name] = (L_shifted - L, inside)
        for name, (value, active) in values.items():
            film.put(name, value / 2, active)
            film.splat(name, camera.pixel, value / 2, active)
        film.put_all(features(self.scene, camera.sensor, camera.random.clone(), camera.rays()[0]))


TOY = Sampler(
    "toy",
    "a toy",
    Toy,
    lambda facts: "" if facts.integrator in ("path", "volpath") else "toys know only 'path' and 'volpath'",
    lambda facts: [f"a note on {facts.integrator}"],
    {"shy": "does nothing"},
    rank=5,
    batch=8,
)


@pytest.fixture(autouse=True)
def toy():
    """One registration, undone after each test."""
    register(TOY)
    yield
    del SAMPLERS["toy"]


NAMES = [*SAMPLERS, "toy"]


def scene_for(renderer, name, size):
    """A quick scene that the sampler can render."""
    from data_gen.scenes.facts import scene_facts

    for description in ("diffuse", "glossy", fog):
        scene = load(renderer, description, size)
        if not SAMPLERS[name].refuses(scene_facts(scene)):
            return scene
    raise AssertionError(f"no scene here for sampler '{name}': add one")


def same(a, b):
    assert a.names == b.names
    for name in a.names:
        assert np.array_equal(a[name], b[name], equal_nan=True), name


@pytest.mark.parametrize("name", NAMES)
def test_unbiased(renderer, name):
    scene = scene_for(renderer, name, (32, 32))
    references = render_references(renderer, scene, spp=128)
    assert references.mean() > 0.01  # black images agree all too well
    stacks = render_ours(scene, name)
    assert ("dx" in stacks[0]) == SAMPLERS[name].gradients
    for layer, result in gradient_tests(stacks, references):
        assert result.passed, f"{layer}: {result}"


@pytest.mark.parametrize("name", NAMES)
def test_variances_are_those_over_seeds(renderer, name):
    """The law that every weight of a reconstruction rests on."""
    stacks = render_ours(scene_for(renderer, name, (24, 16)), name, batches=64, spp=16)
    for layer in ("primal", "dx", "dy"):
        if layer in stacks[0]:
            over_seeds = np.var([stack[layer] for stack in stacks], axis=0, ddof=1, dtype=np.float64).mean()
            told = np.mean([stack[f"{layer}_var"] for stack in stacks], dtype=np.float64)
            assert told == pytest.approx(over_seeds, rel=0.12), layer


@pytest.mark.parametrize("size", [(16, 12), (7, 5)])
@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, size):
    from data_gen import passes
    from data_gen.render import render_stack

    scene = scene_for(renderer, name, size)
    whole = render_stack(scene, 150, 7, name)
    same(whole, render_stack(scene, 150, 7, name))
    calls = []
    monkeypatch.setattr(passes, "_FIRST_LANES", size[0] * size[1] * 40)
    monkeypatch.setattr(passes, "_PASS_SECONDS", 1e-9)
    parts = render_stack(scene, 150, 7, name, lambda done, total: calls.append((done, total)))
    if SAMPLERS[name].batch:
        assert len(calls) == 1 + -(-150 // SAMPLERS[name].batch)
    else:
        # 40 samples are two blocks of 16; what is left over at the end is a pass of its own.
        assert calls == [(n, 150) for n in (0, 32, 48, 64, 80, 96, 112, 128, 144, 150)]
    same(whole, parts)
    assert not np.array_equal(whole["primal"], render_stack(scene, 150, 8, name)["primal"])


@pytest.mark.parametrize("name", NAMES)
def test_memory_stays_within_its_budget(renderer, name):
    import drjit as dr

    from data_gen.render import render_stack

    scene = scene_for(renderer, name, (64, 48))
    whole = render_stack(scene, 100, 1, name)
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    calls = []
    stack = render_stack(scene, 100, 1, name, lambda *call: calls.append(call), memory=40)
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before < 40 * 2**20
    assert len(calls) > 5
    same(whole, stack)


def test_a_toy_is_found_by_all_that_ask(renderer, capsys, tmp_path):
    import ngpt
    from data_gen.inspect import inspect_scene
    from data_gen.render import render_stack
    from data_gen.scenes.facts import Facts
    from ngpt.cli import main

    with pytest.raises(SystemExit):
        main(["render", "--help"])
    assert "toy: a toy" in " ".join(capsys.readouterr().out.split())
    assert main(["info"]) == 0 and "a toy" in capsys.readouterr().out
    # gpt, which knows no media, leaves this scene to the next in rank.
    assert choose(Facts("volpath", ("air",))) == ("toy", find_reason("gpt", Facts("volpath", ("air",))))
    assert choose(Facts("path", ()))[0] == "gpt"
    assert choose(Facts("spectral", ()))[0] == "gpt-basic"
    plan = inspect_scene("diffuse")["plan"]
    assert not any("toy" in line for line in plan)  # it can, and is not chosen
    with pytest.raises(NgptError, match=r"toys know only 'path' and 'volpath'; use --sampler gpt-basic"):
        find("toy", Facts("spectral", ()))
    scene = scene_for(renderer, "toy", (6, 4))
    with pytest.raises(NgptError, match="sampler 'toy' has no option 'loud'; it has: shy"):
        render_stack(scene, 1, sampler="toy", loud=True)
    with pytest.raises(NgptError, match="sampler 'toy' always renders features; only 'primal'"):
        render_stack(scene, 1, sampler="toy", with_features=False)
    assert main(["advise", "diffuse", "--size", "16x12", "--seconds", "5", "--json"]) == 0
    assert '"sampler": "gpt"' in capsys.readouterr().out
    target = tmp_path / "toy.exr"
    assert main(["render", "diffuse", "--size", "6x4", "--spp", "4", "--sampler", "toy", "-o", str(target)]) == 0
    assert ngpt.read(target).attributes["ngpt:sampler"] == "toy"


def test_a_toy_is_compared_at_equal_time(renderer, tmp_path):
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
    rows = {cell["method"]: cell for cell in evaluate(config, tmp_path, Console(quiet=True), "")["cells"]}
    assert rows.keys() == {"wcv (auto)", "wcv (toy)"} and not any(row["absent"] for row in rows.values())
    # The toy, whose samples cost more, gets fewer in the time; but two batches, so that it has a variance.
    assert 2 * TOY.batch <= rows["wcv (toy)"]["spp used"] < rows["wcv (auto)"]["spp used"] == 64


def find_reason(name, facts):
    return SAMPLERS[name].refuses(facts)


def test_names_are_taken_once():
    with pytest.raises(NgptError, match="there is a sampler 'toy' already"):
        register(TOY)
    with pytest.raises(NgptError, match="unknown sampler 'gtp'; choose one of: auto, gpt, gpt-basic"):
        find("gtp")
