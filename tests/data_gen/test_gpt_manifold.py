"""The shift "manifold" of ``gpt``: the light that it follows leaves the layer ``caustic``, and all else stays."""

import drjit as dr
import numpy as np
from data_gen_scenes import caustics
from unbiased import load, render_ours

from data_gen.paths.manifold import follow
from data_gen.render import render_stack
from data_gen.scenes.builtin import _light


def test_light_moves_from_the_layer_to_the_gradients(renderer):
    """The same paths: the image is the same, and the light in it; most of the layer's has a copy now."""
    scene = load(renderer, caustics, (32, 32))
    layer, followed = (
        render_stack(scene, 64, 3, "gpt", shift=shift, unbiased=True) for shift in ("replay", "manifold")
    )
    assert np.allclose(layer["primal"], followed["primal"], rtol=1e-5, atol=1e-6)
    assert followed["caustic"].mean() < 0.3 * layer["caustic"].mean()
    assert (followed["caustic"] <= layer["caustic"] * (1 + 1e-5) + 1e-6).all()
    assert layer["primal_var"].mean() < followed["primal_var"].mean()


def test_less_noise_than_replay(renderer):
    """A small lamp in a curved mirror, wide enough for a pixel: replay misses it, walks do not."""
    description = caustics() | {"lamp": _light([0.2, 2.6, -0.2], [0, -1, 0], (0.4, 0.4), (60, 60, 60))}
    del description["glass"]
    scene = load(renderer, description, (48, 48))
    plain, layer, followed = (
        render_stack(scene, 128, 3, "gpt", unbiased=True, **options)
        for options in ({"caustic": False}, {}, {"shift": "manifold"})
    )
    for name in ("dx_var", "dy_var"):
        # Beside what all other light contributes
        by_replay, by_walks = (stack[name].mean() - layer[name].mean() for stack in (plain, followed))
        assert by_walks < 0.4 * by_replay


def test_the_second_kernel_finds_what_the_first_has_recorded(renderer, monkeypatch):
    """Where all walks are refused, the samples are -2 b: those of a lane say again what its primal holds."""
    from data_gen.samplers.gpt import integrator, manifold_shift

    light = {}

    def refused(*args, **more):
        ω, shot, J, found = follow(*args, **more)
        return ω, shot, J, found & False

    def kept(plan, first_hit, camera, shifts, chain, Δ):
        before = [renderer.Color3f(d) for d in Δ]
        after = manifold_shift.add_followed(plan, first_hit, camera, shifts, chain, Δ)
        light["recorded"] = np.array(chain.record) != 0
        light["samples"] = np.stack([np.array(b - a).T for a, b in zip(before, after, strict=True)])
        return after

    put = integrator.GradientFilm.put

    def remember(film, name, value, active=True):
        light.setdefault(name, np.array(value).T)
        put(film, name, value, active)

    monkeypatch.setattr(manifold_shift, "follow", refused)
    monkeypatch.setattr(integrator, "add_followed", kept)
    monkeypatch.setattr(integrator.GradientFilm, "put", remember)
    scene = load(renderer, caustics, (32, 32))
    render_ours(scene, "gpt", batches=1, shift="manifold")
    samples, recorded, rest = light["samples"], light["recorded"], light.pop("caustic")
    render_ours(scene, "gpt", batches=1, shift="replay")
    followed = light["caustic"] - rest
    assert recorded.sum() > 100 and not followed[~recorded].any() and not samples[:, ~recorded].any()
    for own in samples:
        assert np.allclose(own[recorded], -2 * followed[recorded], rtol=1e-3, atol=1e-5)


def test_scenes_without_mirrors_have_the_same_kernels(renderer):
    scene = load(renderer, "diffuse", (8, 8))

    def kernels(**options):
        render_stack(scene, 1, 0, "gpt", unbiased=True, **options)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            render_stack(scene, 1, 0, "gpt", unbiased=True, **options)
            return [kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel]

    assert kernels() and kernels() == kernels(shift="manifold")
