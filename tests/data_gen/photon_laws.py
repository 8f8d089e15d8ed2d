"""What tests of photons share: passes, differences pair by pair, images beside each other, copies of photons."""

import media_scenes
import numpy as np
from unbiased import differences, far_shifts, light_of_gradients, load


def largest(value) -> float:
    return np.abs(np.array(value, np.float64)).max()


def joined(one, other, mi, dr):
    """Two records as one: all arrays of the other behind those of the first."""
    n, m = dr.width(one.p), dr.width(other["p"])
    index = dr.arange(mi.UInt32, n + m)
    values = {}
    for name, old in vars(one).items():
        new = other[name]
        both = dr.gather(type(old), old, index, index < n), dr.gather(type(old), new, index - n, index >= n)
        values[name] = dr.select(index < n, *both)
    dr.eval(values)
    return type(one)(**values)


def passes(scene, n, pixels=1, sampler="gpm", **options):
    """The layers of ``n`` first passes, each of another seed: what ``render_ours`` has, prepared once."""
    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import find

    sample, sensor = find(sampler).made(scene, **options), scene.sensors()[0]
    stacks = []
    with far_shifts(pixels), recording():
        for seed in range(n):
            film = GradientFilm(*(int(n) for n in sensor.film().crop_size()), batches=True)
            sample(CameraSamples(sensor, seed, 1), film)
            film.end_pass(1)
            stacks.append(film.develop())
    return stacks


def paired(stacks, pixels, block):
    """z of dx and dy minus the differences of the same image, over blocks: both have the same mean, bias included."""
    off = []
    for stack in stacks:
        slopes = differences(np.asarray(light_of_gradients(stack), np.float64), pixels)
        off.append([stack[name] - slope for name, slope in zip(("dx", "dy"), slopes, strict=True)])
    n, two, height, width, _ = np.shape(off)
    blocks = np.reshape(off, (n, two, height // block, block, width // block, block, 3)).mean(axis=(3, 5, 6))
    error = blocks.std(axis=0, ddof=1) / np.sqrt(n)
    return (blocks.mean(axis=0) / np.where(error > 0, error, np.inf)).ravel()


def assert_no_bias(stacks, pixels):
    """The largest z of blocks of 4x4 pixels, and the mean of all squares of 2x2."""
    largest, squares = np.abs(paired(stacks, pixels, 4)).max(), np.mean(paired(stacks, pixels, 2) ** 2)
    assert largest < 4.5 and squares < 1.6, (largest, squares)


def gain(stacks):
    """Variance of differences of independent images over that of dx and dy: in the mean and in the median."""
    L = np.stack([light_of_gradients(stack) for stack in stacks]).astype(np.float64)
    variance = L.var(axis=0, ddof=1)
    ratios, sums = [], np.zeros(2)
    for name, axis in (("dx", 1), ("dy", 0)):
        ours = np.stack([stack[name] for stack in stacks]).astype(np.float64).var(axis=0, ddof=1)
        pixels = variance + np.roll(variance, -1, axis=axis)
        inner = np.s_[:-1, :-1]
        sums += pixels[inner].sum(), ours[inner].sum()
        ratios.append((pixels[inner] / np.where(ours[inner] > 0, ours[inner], np.nan)).ravel())
    return sums[0] / sums[1], np.nanmedian(ratios)


def assert_alike(images, references, block):
    """Means of blocks differ by no more than 4 standard errors and 3 % of the image, which may be bias."""

    def blocks(stack):
        n, height, width, _ = stack.shape
        x = stack.reshape(n, height // block, block, width // block, block, 3).mean(axis=(2, 4))
        return x.mean(axis=0), x.var(axis=0, ddof=1) / n

    (ours, ours_var), (theirs, theirs_var) = blocks(images), blocks(references)
    off = np.abs(ours - theirs) - 4 * np.sqrt(ours_var + theirs_var)
    assert off.max() < 0.03 * theirs.mean(), (off.max(), theirs.mean())


def maps_of(mi, scene, paths=4096, max_depth=6):
    """The maps of so many light paths, and the light's end of them."""
    import drjit as dr

    from data_gen.paths.light_ends import LightEnds
    from data_gen.paths.streams import sample_streams
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.photons.map.trace import trace

    random = sample_streams(0, dr.arange(mi.UInt32, paths), mi.UInt32(0))
    start, maps = trace(World(scene, LightEnds(scene), Materials(scene, 0.05)), random, max_depth, 4)
    return start, list(maps)


def assert_copies_are_light_paths(mi, name, receivers):
    """By the densities and throughputs of the copy itself, evaluated anew: r(T(x)) r(x) = 1, and T(T(x)) = x.

    ``receivers`` (eye, photons' places, their media, random numbers) has what photons are gathered at and copied to,
    and the squared radius.
    """
    import drjit as dr

    from data_gen.paths import media
    from data_gen.paths.light_ends import LightEnds, LightRay
    from data_gen.paths.streams import sample_streams
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
    from data_gen.samplers.photons.gradients.copies import LightPaths, start_of
    from data_gen.samplers.photons.map.fog import Fog
    from data_gen.samplers.photons.map.photon import Photon, photon_of
    from data_gen.samplers.photons.map.trace import trace
    from data_gen.samplers.photons.map.vertices import vertex_in_media_of
    from data_gen.samplers.photons.media.gbre import copy_beside

    scene = load(mi, getattr(media_scenes, name), (8, 8))
    lights, n = LightEnds(scene), 1 << 14
    ways = Fog(scene, scene.sensors()[0], lights, "gbre")
    random = sample_streams(0, dr.arange(mi.UInt32, n), mi.UInt32(0))
    world = World(scene, lights, Materials(scene, 0.05, media.index_matched, media=True), ways)
    starts, maps = trace(world, random, 6, 4)
    photons = next(maps)
    inside = (np.array(photons.depth) > 0) & (np.abs(np.array(photons.n)).sum(axis=0) == 0)
    rng = np.random.default_rng(0)
    j = mi.UInt32(rng.choice(np.flatnonzero(inside), 4000))
    photon = photon_of(photons, j)
    A, B, r2 = receivers(np.array(ways.eye), np.array(photon.p), dr.gather(mi.MediumPtr, photons.medium, j), rng)
    apart = A.near(photon.p, r2)[1] & ~B.near(photon.p, r2)[1]
    moved, _, r, good = copy_beside(world, LightPaths(starts, photons), photon, A, B, r2)
    good &= apart

    # The copy as a photon of its own, with what its predecessor has to say of it
    parent, first = dr.gather(mi.UInt32, photons.parent, j), dr.gather(mi.Float, photons.density, j) == 0
    a, place = vertex_in_media_of(photons, parent, ~first)
    _, density, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(moved.d), ~first & ~place.scatters)
    phase = place.medium.phase_function()
    _, of_phase = phase.eval_pdf(mi.PhaseFunctionContext(), media.in_medium(a, place), moved.d, place.scatters)
    density = dr.select(place.scatters, of_phase, density)
    start = start_of(starts, parent, first)
    there = dr.zeros(mi.Interaction3f, 4000)
    there.p = moved.p + (start.end.p - start.ray.o)
    turned, ratio, _ = lights.redirected(scene, start, there)
    lane = dr.arange(mi.UInt32, 4000)
    fields = {field: dr.gather(type(value), value, j) for field, value in vars(photons).items()}
    fields |= {"p": moved.p, "d": moved.d, "β": moved.Φ}
    fields |= {"density": dr.select(first, 0, density), "parent": dr.select(first, lane + n, parent)}
    fields = {field: type(getattr(photons, field))(value) for field, value in fields.items()}
    more = joined(photons, fields, mi, dr)
    index = dr.arange(mi.UInt32, n + 4000)
    old = index < n

    def both(one, other):
        return dr.select(old, dr.gather(type(one), one, index, old), dr.gather(type(one), other, index - n, ~old))

    way = mi.Ray3f(both(starts.ray.o, start.ray.o), both(starts.ray.d, turned.ray.d), starts.ray.time, [])
    end = dr.zeros(mi.DirectionSample3f, n + 4000)
    end.p, end.n = both(starts.end.p, start.end.p), both(starts.end.n, start.end.n)
    # Le cos / p with its own p
    β = both(starts.β, dr.select(ratio > 0, turned.β / ratio, 0))
    kinds = (both(getattr(starts, field), getattr(start, field)) for field in ("emitter", "index"))
    more_starts = LightRay(way, β, *kinds, end, both(starts.delta, start.delta))
    place, of_media = lane + len(photons), {"medium": photon.medium, "channel": photon.channel}
    copied = Photon(moved.p, moved.n, moved.d, moved.Φ, place, **of_media)
    back, _, r_back, good_back = copy_beside(world, LightPaths(more_starts, more), copied, B, A, r2)
    # Of as many as may have one: light from mirrors is not here, walls and boundaries may be in the way.
    assert np.array(good).sum() > (0.7 if name == "nested" else 0.9) * np.array(apart).sum() > 300
    good, good_back = np.array(good), np.array(good_back)
    assert (good & good_back).sum() > 0.97 * good.sum()
    good &= good_back
    error = np.abs(np.array(r, np.float64) * np.array(r_back, np.float64) - 1)[good]
    assert np.median(error) < 5e-4 and np.quantile(error, 0.95) < 2e-2
    assert np.std(np.log(np.array(r)[good])) > 1e-3
    # Φ'' has the density of the copy.
    power = np.array(back.Φ * r, np.float64)[:, good] / np.array(photon.Φ, np.float64)[:, good]
    assert np.median(np.abs(power - 1)) < 5e-4 and np.quantile(np.abs(power - 1), 0.95) < 2e-2
    away = np.linalg.norm(np.array(back.p) - np.array(photon.p), axis=0)[good]
    assert np.median(away) < 2e-5 and np.quantile(away, 0.95) < 1e-3


def beside(g, b, o, d, u, e):
    """The copy, beside the ray (u, e), of a photon beside (o, d)."""
    from data_gen.samplers.photons.gradients.shift import moved

    t = g.dr.dot(b - o, d)
    return moved(b, o + d * t, d, u + e * t, e)
