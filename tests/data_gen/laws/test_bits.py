"""The same seed gives the same bits, whatever the passes and the memory; and a render stays within its memory."""

import drjit as dr
import numpy as np
import pytest
from media_scenes import wisps
from registered import cases, quick, scene_for, slow
from unbiased import load, same

from data_gen import passes
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS

# What has kernels or rounds of its own: sampler, scene, samples, options
MORE = [
    ("gpt", "glossy", 40, {"tails": "shared"}),
    ("primal", "diffuse", 40, {"tails": "shared"}),
    slow("gpt", "diffuse", 70, {"reuse": True}),
    slow("bre", wisps, 3, {}),
]


def split_passes(monkeypatch, lanes=1):
    """Passes are as short as they can be."""
    monkeypatch.setattr(passes, "FIRST_LANES", lanes)
    monkeypatch.setattr(passes, "PASS_SECONDS", 1e-9)


@pytest.mark.parametrize(("name", "full"), cases())
def test_the_same_seed_gives_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, full):
    batch, size = SAMPLERS[name].batch, (7, 5)
    scene = scene_for(renderer, name, size)
    spp = 3 * batch + 1 if not full else 20 if batch == 1 else 150
    whole, calls = render_stack(scene, spp, 7, name, unbiased=True), []
    split_passes(monkeypatch, size[0] * size[1] * 40)
    same(whole, render_stack(scene, spp, 7, name, lambda done, total: calls.append((done, total)), unbiased=True))
    if batch:
        assert len(calls) == 1 + -(-spp // batch)
    else:
        # 40 samples are two blocks of 16; what is left over at the end is a pass of its own.
        assert calls == [(n, 150) for n in (0, 32, 48, 64, 80, 96, 112, 128, 144, 150)]
    assert not np.array_equal(whole["primal"], render_stack(scene, spp, 8, name, unbiased=True)["primal"])


@pytest.mark.parametrize(("name", "scene", "spp", "options"), MORE)
def test_options_give_the_same_bits_whatever_the_passes(renderer, monkeypatch, name, scene, spp, options):
    have_the_same_bits(renderer, monkeypatch, name, scene, spp, options)


def have_the_same_bits(renderer, monkeypatch, name, scene, spp, options):
    scene, calls = load(renderer, scene, (16, 12)), []
    whole = render_stack(scene, spp, 5, name, unbiased=True, **options)
    split_passes(monkeypatch)
    same(whole, render_stack(scene, spp, 5, name, lambda *call: calls.append(call), unbiased=True, **options))
    assert whole["primal"].any() and len(calls) > 2
    assert not np.array_equal(whole["primal"], render_stack(scene, spp, 6, name, unbiased=True, **options)["primal"])


@pytest.mark.parametrize(("name", "full"), cases())
def test_memory_stays_within_its_budget(renderer, name, full):
    batch, scene, calls = SAMPLERS[name].batch, load(renderer, quick(renderer, name), (64, 48)), []
    spp = 5 * batch if not full else 8 if batch == 1 else 100
    # Photons with copies along rays, and whole paths that are recorded as one function, need more for any pass at all.
    memory = 60 if batch == 1 or name == "gpt-basic" else 40
    whole = render_stack(scene, spp, 1, name, unbiased=True)
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    stack = render_stack(scene, spp, 1, name, lambda *call: calls.append(call), memory=memory, unbiased=True)
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before < memory * 2**20
    assert len(calls) > 5
    same(whole, stack)
