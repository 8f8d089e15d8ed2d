"""The same seed gives the same bits, whatever the passes; and a render stays within its memory."""

import drjit as dr
import numpy as np
import pytest
from media_scenes import wisps
from registered import cases, quick, slow
from unbiased import load, same, stacks_of

from data_gen import passes
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS

# Samplers with kernels or rounds of their own: sampler, scene, samples, options
MORE = [
    ("gpt", "glossy", 40, {"tails": "shared"}),
    ("primal", "diffuse", 40, {"tails": "shared"}),
    slow("gpt", "diffuse", 70, {"reuse": True}),
    slow("bre", wisps, 3, {}),
]


def have_the_same_bits(renderer, monkeypatch, name, scene, spp, *, size=(16, 12), **options):
    """Asserts that a render in long passes and one in the shortest passes, after a first pass of 40 samples, are equal.

    The render in long passes is the second one of its sampler, which must keep nothing of the first. Returns the
    progress reports of the other one.
    """
    scene, calls = load(renderer, scene, size), []
    other, whole = stacks_of(scene, name, 2, spp, 4, **options)
    monkeypatch.setattr(passes, "FIRST_LANES", size[0] * size[1] * 40)
    monkeypatch.setattr(passes, "PASS_SECONDS", 1e-9)
    same(whole, render_stack(scene, spp, 5, name, lambda *call: calls.append(call), unbiased=True, **options))
    assert whole["primal"].any() and len(calls) > 2
    assert not np.array_equal(whole["primal"], other["primal"])
    return calls


@pytest.mark.parametrize(("name", "full"), cases())
def test_the_same_seed_gives_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, full):
    batch = SAMPLERS[name].batch
    spp = 3 * batch + 1 if not full else 20 if batch == 1 else 150
    calls = have_the_same_bits(renderer, monkeypatch, name, quick(renderer, name), spp, size=(7, 5))
    if batch:
        assert len(calls) == 1 + -(-spp // batch)
    else:
        # 40 samples are two blocks of 16; what is left over at the end is a pass of its own.
        assert calls == [(n, 150) for n in (0, 32, 48, 64, 80, 96, 112, 128, 144, 150)]


@pytest.mark.parametrize(("name", "scene", "spp", "options"), MORE)
def test_options_give_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, scene, spp, options):
    have_the_same_bits(renderer, monkeypatch, name, scene, spp, **options)


@pytest.mark.parametrize(("name", "full"), cases())
def test_memory_stays_within_its_budget(renderer, name, full):
    batch, scene, calls = SAMPLERS[name].batch, load(renderer, quick(renderer, name), (64, 48)), []
    spp = 5 * batch if not full else 8 if batch == 1 else 100
    # Photons with copies along rays, and whole paths that are recorded as one function, need more for any pass at all.
    memory = 60 if batch == 1 or name == "gpt-basic" else 40
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    render_stack(scene, spp, 1, name, lambda *call: calls.append(call), memory=memory, unbiased=True)
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before < memory * 2**20
    assert len(calls) > 5
