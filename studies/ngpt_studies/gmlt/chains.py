"""Markov chains of paths, run in parallel, which splat the light they find; and mutations of a path's random numbers.

[Kelemen et al. 2002, "A Simple and Robust Mutation Strategy for the Metropolis Light Transport Algorithm"]
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.gpt.trace import trace

# The limits of small steps, for numbers in [0, 1). The logarithms of steps are uniform between them.
SMALLEST, LARGEST = 1 / 1024, 1 / 64
# The random numbers that a chain remembers: 6 of the camera, then 6 for each of 8 vertices. Further numbers are new in
# each mutation.
REMEMBERED = 6 + 8 * 6


def small_step(x: mi.Float, u: mi.Float) -> mi.Float:
    """``x`` in [0, 1), moved by a small step that the uniform number ``u`` chooses.

    Steps to both sides are equally likely, and [0, 1) is a circle, so a step and its reverse have the same density.
    """
    left = u < 0.5
    u = dr.select(left, 2 * u, 2 * u - 1)
    step = LARGEST * dr.exp(u * dr.log(SMALLEST / LARGEST))
    x = x + dr.select(left, -step, step)
    x -= dr.floor(x)
    # A number just below 0 may be rounded to 1.
    return dr.select(x < 1, x, 0)


def acceptance(f: mi.Float, proposed: mi.Float) -> mi.Float:
    """The probability that a chain moves from a state of value ``f`` to a state of value ``proposed``."""
    return dr.select(proposed < f, proposed / f, dr.select(proposed > 0, mi.Float(1), 0))


@dataclass
class Proposal:
    """Draws the numbers of a mutation one after the other, in place of a sampler."""

    vector: dr.Local  # the numbers of the chain's state
    random: mi.PCG32  # draws one number for each of these
    large: mi.Bool  # whether all numbers are new, independent of the state
    count: mi.UInt32

    def next_1d(self, active=True) -> mi.Float:
        u = self.random.next_float32()
        remembered = self.count < REMEMBERED
        x = self.vector.read(dr.minimum(self.count, REMEMBERED - 1))
        self.count = self.count + 1
        return dr.select(self.large | ~remembered, u, small_step(x, u))

    def next_2d(self, active=True) -> mi.Point2f:
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())


def taken(vector: dr.Local, random: mi.PCG32, large: mi.Bool, accepted: mi.Bool) -> dr.Local:
    """The ``vector`` after a mutation: where that is ``accepted``, the numbers that its ``Proposal`` drew."""

    def write(i, proposal):
        x = proposal.next_1d()
        proposal.vector.write(x, i, accepted)
        return i + 1, proposal

    state = (mi.UInt32(0), Proposal(vector, mi.PCG32(random), mi.Bool(large), mi.UInt32(0)))
    return dr.while_loop(state, lambda i, _: i < REMEMBERED, write, label="mutation")[1].vector


# The share of large steps: mutations to numbers that are independent of the state
LARGE_STEPS = 0.05
# The weight of each difference in the value of a path; its light has weight 1
GRADIENTS = 0.25


def value_of(layers: dict[str, mi.Color3f]) -> mi.Float:
    """f, the value of a path: the luminance of its light, plus ``GRADIENTS`` times that of its four differences.

    If a path has anything to splat, f is above 0. [Lehtinen et al. 2013, section 4]
    """
    f = mi.Float(0)
    for name, light in layers.items():
        f += mi.luminance(dr.abs(light)) * (GRADIENTS if name in SHIFTS else 1)
    return dr.select(dr.isfinite(f), f, 0)


class Paths:
    """Traces paths of ``gpt``. Their layers are the light that is not seen directly, and four differences."""

    def __init__(self, gpt, scene, plan):
        self.gpt, self.scene, self.plan = gpt, scene, plan
        # Made here, and not within the loop of a chain
        self.shifts = {name: mi.Vector2f(*(dr.opaque(mi.Float, s) for s in shift)) for name, shift in SHIFTS.items()}

    def trace(self, camera: CameraSamples, random) -> tuple[dict[str, mi.Color3f], mi.Color3f, dict[str, mi.Bool]]:
        """For paths with these ``random`` numbers: layers, light seen directly, which neighbours are on the film."""
        ray, importance, _ = camera.rays(mi.Vector2f(0))
        shifted = {name: camera.rays(shift) for name, shift in self.shifts.items()}
        paths = trace(self.gpt, self.plan, random, (ray, importance), list(shifted.values()))
        layers = {"primal": to_rgb(paths.L, ray.wavelengths)}
        if self.plan.caustic:
            layers["caustic"] = to_rgb(paths.L_caustic, ray.wavelengths)
        inside = {name: inside for name, (_, _, inside) in shifted.items()}
        for (name, exists), y in zip(inside.items(), paths.offsets, strict=True):
            layers[name] = dr.select(exists, to_rgb(y.Δ, ray.wavelengths), 0)
        return layers, to_rgb(paths.Le, ray.wavelengths), inside


@dataclass
class State:
    """The state of a chain: its random numbers, its path, and the light of the path that is not splatted yet."""

    vector: dr.Local
    pixel: mi.UInt32
    layers: dict
    f: mi.Float  # the value of the path
    weight: mi.Float  # the expected number of steps that the chain has spent in this state
    accepted: mi.UInt32  # the number of accepted mutations so far


def run(
    paths: Paths,
    camera: CameraSamples,
    start: mi.UInt32,
    layers: dict[str, mi.Color3f],
    f: mi.Float,
    film: GradientFilm,
    *,
    steps: int,
    scale: Callable[[mi.Float], mi.Float],
) -> mi.Float:
    """Runs chains for ``steps`` mutations; returns the share of mutations that each chain accepted.

    ``layers`` and ``f`` are the layers and values of all paths of ``camera``. Chains begin with the paths in the lanes
    ``start``. A state of value f counts ``scale(f)`` for each step that a chain is expected to spend there: both the
    current state and the proposed one are splatted, whichever is accepted. [Veach and Guibas 1997, "Metropolis Light
    Transport", section 5.1]
    """
    splats = {name: film.splats(name) for name in layers}

    def splat(state: State) -> None:
        counts = dr.select(state.weight > 0, state.weight * scale(state.f), 0)
        for name, light in state.layers.items():
            splats[name].add(state.pixel, list(light * counts), dr.max(dr.abs(light)) * counts > 0)

    def step(i: mi.UInt32, old: State):
        # Drawn before the numbers of the path, since some paths draw more of them than others.
        random = stream(keys, i)
        large, u = random.next_float32() < LARGE_STEPS, random.next_float32()
        proposal = Proposal(old.vector, mi.PCG32(random), large, mi.UInt32(0))
        there, pixel = moved(camera, proposal)
        layers, _, _ = paths.trace(there, proposal)
        f = value_of(layers)
        a = acceptance(old.f, f)
        accepted = u < a
        # The chain leaves one of the two states for good, so the weight of that state is final.
        new = State(None, pixel, layers, f, a, old.accepted + 1)
        stays = State(None, old.pixel, old.layers, old.f, old.weight + 1 - a, old.accepted)
        splat(dr.select(accepted, stays, new))
        state = dr.select(accepted, new, stays)
        state.vector = taken(old.vector, random, large, accepted)
        return i + 1, state

    # ---------------------- First states -------------------------
    there = camera.at(start)
    vector = first_numbers(there)
    layers = {name: dr.gather(mi.Color3f, light, start) for name, light in layers.items()}
    pixel, f = dr.gather(mi.UInt32, camera.pixel, start), dr.gather(mi.Float, f, start)
    chain = dr.arange(mi.UInt32, dr.width(start))
    # Several chains may begin with the same path, so keys also depend on the chain.
    keys = mi.sample_tea_32(there.random.clone().next_key(), chain)
    dr.eval(layers, pixel, f, keys)
    # ------------------------- Steps -----------------------------
    n = dr.opaque(mi.UInt32, steps)
    state = State(vector, pixel, layers, f, dr.zeros(mi.Float, dr.width(start)), dr.zeros(mi.UInt32, dr.width(start)))
    _, state = dr.while_loop((mi.UInt32(0), state), lambda i, _: i < n, step, label="chains")
    splat(state)
    accepted = state.accepted / mi.Float(n)
    dr.eval(accepted)
    return accepted


def stream(keys: tuple[mi.UInt32, mi.UInt32], step: mi.UInt32) -> mi.PCG32:
    a, b = mi.sample_tea_32(keys[0], step)
    random = mi.PCG32()
    random.seed(mi.UInt64(a) | (mi.UInt64(b) << 32), mi.UInt64(keys[1]))
    return random


def first_numbers(camera: CameraSamples) -> dr.Local:
    """The random numbers of these camera samples and their paths, in the order of ``moved`` and then the path."""
    sensor, position = camera.sensor, camera.position / mi.Vector2f(camera.size)
    open_time = sensor.shutter_open_time()
    time = (camera.time - sensor.shutter_open()) / open_time if open_time > 0 else mi.Float(0)
    numbers = [position.x, position.y, camera.lens.x, camera.lens.y, time, mi.Float(camera.wavelength)]
    vector, random = dr.alloc_local(mi.Float, REMEMBERED), camera.random.clone()
    for i, x in enumerate(numbers):
        vector.write(x, mi.UInt32(i))

    def draw(i, vector, state):
        further = type(random)(state)
        vector.write(further.next_1d(), i)
        return i + 1, vector, further.state

    state = (mi.UInt32(len(numbers)), vector, random.state)
    return dr.while_loop(state, lambda i, *_: i < REMEMBERED, draw, label="numbers")[1]


def moved(camera: CameraSamples, random: Proposal) -> tuple[CameraSamples, mi.UInt32]:
    """The camera samples with other ``random`` numbers for position, lens, time and wavelength; and their pixels."""
    there = copy(camera)
    there.position = random.next_2d() * mi.Vector2f(camera.size)
    there.lens = random.next_2d()
    there.time = camera.sensor.shutter_open() + camera.sensor.shutter_open_time() * random.next_1d()
    there.wavelength = random.next_1d()
    x, y = (dr.minimum(mi.UInt32(p), n - 1) for p, n in zip(there.position, camera.size, strict=True))
    return there, x + y * camera.size.x
