"""What tests of photons share: maps, and images beside each other."""

import media_scenes
import numpy as np
from bdpt_scenes import SCENES
from references import references
from renders import dr, mi
from unbiased import assert_unbiased, load, render_ours

from data_gen.film import GradientFilm
from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.streams import sample_streams
from data_gen.paths.vertex import Materials
from data_gen.samplers import find
from data_gen.samplers.photons.map.trace import trace


def assert_alike(images, references, block, share=0.03):
    """Means of blocks differ by no more than 4 standard errors and a share of the image, which may be bias."""

    def blocks(stack):
        n, height, width, _ = stack.shape
        x = stack.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4))
        return x.mean(axis=0), x.var(axis=0, ddof=1) / n

    (ours, ours_var), (theirs, theirs_var) = blocks(images), blocks(references)
    off = np.abs(ours - theirs) - 4 * np.sqrt(ours_var + theirs_var)
    assert theirs.mean() > 0.01 and off.max() < share * theirs.mean(), (off.max(), theirs.mean())


def traced(world, paths=4096, max_depth=6):
    """The maps of so many light paths."""
    return list(trace(world, sample_streams(0, dr.arange(mi.UInt32, paths), mi.UInt32(0)), max_depth, 4))


def world_of(scene, **more):
    """What photons are traced in; ``more`` as of ``Materials``."""
    return World(scene, LightEnds(scene), Materials(scene, 0.05, **more))


def assert_recorded_once(renderer, monkeypatch, recordings, sampler, least):
    """Kernels make the same bits as if they were recorded in each pass; more than ``least`` functions make them."""
    scene = load(renderer, "diffuse", (16, 12))

    def rendered(others=()):
        take, film = find(sampler).made(scene), GradientFilm(16, 12, batches=True)
        for i in range(3):
            with recording():
                take(CameraSamples(scene.sensors()[0], 3, 1, i), film)
                film.end_pass(1)
            others = [load(renderer, other, (4, 4)) for other in others] if i == 0 else []
        return film.develop()

    layers = rendered()
    # A function is recorded again where two arrays happen to be of one size, or of size 1.
    assert len(recordings.of) > least and recordings.total() <= len(recordings.of) + 2
    # Other scenes come and go.
    with_others = rendered([SCENES["areas"]])
    monkeypatch.setattr(Frozen, "__call__", lambda self, f, *args: f(*args))
    anew = rendered()
    assert layers.keys() == anew.keys()
    for name in layers:
        assert np.array_equal(layers[name], anew[name]) and np.array_equal(layers[name], with_others[name]), name


def assert_lamps_behind_grids_are_seen(renderer, name):
    ours = render_ours(load(renderer, media_scenes.seen_through, (16, 16)), name, batches=8, spp=12)
    expected = references(renderer, media_scenes.seen_through, (16, 16))
    assert_unbiased([{"primal": stack["primal"]} for stack in ours], expected)
