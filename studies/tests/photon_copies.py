"""What tests of photons with gradients share: differences pair by pair, maps with light paths, copies of photons."""

import numpy as np
from renders import dr, mi
from unbiased import differences, light_of_gradients

from data_gen.paths import media
from data_gen.paths.light_ends import LightRay
from data_gen.paths.streams import sample_streams
from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
from ngpt_studies.photons.gradients.copies import LightPaths, start_of
from ngpt_studies.photons.map.trace import trace
from ngpt_studies.photons.map.vertices import Photon, photon_of, vertex_in_media_of, vertex_of


def largest(value) -> float:
    return np.abs(np.array(value, np.float64)).max()


def joined(one, other):
    """Two records as one: all arrays of the other behind those of the first."""
    n, m = dr.width(one.p), dr.width(other["p"])
    index = dr.arange(mi.UInt32, n + m)
    values = {}
    for name, old in vars(one).items():
        new = type(old)(other[name])
        both = dr.gather(type(old), old, index, index < n), dr.gather(type(old), new, index - n, index >= n)
        values[name] = dr.select(index < n, *both)
    dr.eval(values)
    return type(one)(**values)


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


def traced(world, paths=4096, max_depth=6, **more):
    """The light's end of so many light paths, and their maps."""
    random = sample_streams(0, dr.arange(mi.UInt32, paths), mi.UInt32(0))
    start, maps = trace(world, random, max_depth, 4, **more)
    return start, list(maps)


def assert_copies_are_light_paths(world, paths, j, shift, least=0.0):
    """By the densities and throughputs of the copy itself, evaluated anew: r(T(x)) r(x) = 1, and T(T(x)) = x.

    ``shift(paths, photon, back)`` gives (copy, r, whether there is one, whether it was asked for) of photons, those
    ``j`` of the map of ``paths``; ``back`` is None, or says which copies go back. ``least``: the share that have one.
    """
    photons, starts, fog, lights = paths.photons, paths.starts, world.fog is not None, world.lights
    photon, n, m = photon_of(photons, j), dr.width(paths.starts.ray.d), dr.width(j)
    moved, r, good, apart = shift(paths, photon, None)

    # The copy as a photon of its own, with what its predecessor has to say of it
    parent, first = dr.gather(mi.UInt32, photons.parent, j), dr.gather(mi.Float, photons.density, j) == 0
    scatters = mi.Bool(False)
    if fog:
        a, place = vertex_in_media_of(photons, parent, ~first)
        scatters = place.scatters
    else:
        a = vertex_of(photons, parent, ~first)
    _, density, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(moved.d), ~first & ~scatters)
    if fog:
        phase, here = place.medium.phase_function(), media.in_medium(a, place)
        _, of_phase = phase.eval_pdf(mi.PhaseFunctionContext(), here, moved.d, scatters)
        density = dr.select(scatters, of_phase, density)
    start, lane = start_of(starts, parent, first), dr.arange(mi.UInt32, m)
    there = dr.zeros(mi.Interaction3f, m)
    there.p = moved.p + (start.end.p - start.ray.o)
    turned, ratio, _ = lights.redirected(world.scene, start, there)
    beyond = lights.far(start.index)
    to = dr.select(first, dr.select(beyond, moved.d, moved.p - start.ray.o), moved.p - a.spawn_ray(moved.d).o)
    fields = {field: dr.gather(type(value), value, j) for field, value in vars(photons).items()}
    fields |= {"p": moved.p, "n": moved.n, "d": moved.d, "β": moved.Φ, "t": dr.norm(to)}
    # A density of 0 marks the first photon of a path, whose parent is a light's start: no other copy may have it, even
    # one that does not exist (its lane goes back with the others, masked).
    density = dr.select(first, 0, dr.select(density > 0, density, 1))
    fields |= {"density": density, "parent": dr.select(first, lane + n, parent)}
    more = joined(photons, fields)
    index = dr.arange(mi.UInt32, n + m)

    def both(one, other):
        known = dr.gather(type(one), one, index, index < n), dr.gather(type(one), other, index - n, index >= n)
        return dr.select(index < n, *known)

    origin = dr.select(beyond, moved.p - moved.d, start.ray.o)
    way = mi.Ray3f(both(starts.ray.o, origin), both(starts.ray.d, turned.ray.d), starts.ray.time, [])
    end = dr.zeros(mi.DirectionSample3f, n + m)
    end.p, end.n = both(starts.end.p, start.end.p), both(starts.end.n, start.end.n)
    # Le cos / p with its own p
    β = both(starts.β, dr.select(ratio > 0, turned.β / ratio, 0))
    kinds = (both(getattr(starts, field), getattr(start, field)) for field in ("emitter", "index"))
    more_starts = LightRay(way, β, *kinds, end, both(starts.delta, start.delta))
    around = {"medium": photon.medium, "channel": photon.channel} if fog else {}
    copied = Photon(moved.p, moved.n, moved.d, moved.Φ, lane + len(photons), **around)
    back, r_back, good_back, _ = shift(LightPaths(more_starts, more), copied, good)

    good, good_back, asked = np.array(good), np.array(good_back), np.array(apart).sum()
    assert good.sum() > max(100, least * asked) and (good & good_back).sum() > 0.97 * good.sum(), (good.sum(), asked)
    good &= good_back

    def off(values, median, most):
        values = np.broadcast_to(values, (*values.shape[:-1], len(good)))[..., good]
        assert np.median(values) < median and np.quantile(values, 0.95) < most, np.quantile(values, [0.5, 0.95])

    off(np.abs(np.array(r, np.float64) * np.array(r_back, np.float64) - 1), 5e-4, 2e-2)
    assert np.std(np.log(np.array(r)[good])) > 1e-3
    # Φ'' has the density of the copy.
    power, power_back = np.array(photon.Φ, np.float64), np.array(back.Φ * r, np.float64)
    off(np.abs(power_back - power) / power.max(axis=0), 5e-4, 2e-2)
    off(np.linalg.norm(np.array(back.p) - np.array(photon.p), axis=0), 2e-5, 1e-3)
