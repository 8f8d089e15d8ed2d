"""Mutations of the random numbers that a path is made of, and whether a chain takes them.

[Kelemen et al. 2002, "A Simple and Robust Mutation Strategy for the Metropolis Light Transport Algorithm"]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

# Small steps are from the one to the other, of the range of a number; their logarithms are uniform.
SMALLEST, LARGEST = 1 / 1024, 1 / 64
# Numbers that a chain remembers: 6 of the camera, then 6 for each vertex. Further numbers are new in each mutation.
REMEMBERED = 6 + 8 * 6


def small_step(x: mi.Float, u: mi.Float) -> mi.Float:
    """``x`` in [0, 1), moved by a small step that the uniform number ``u`` chooses.

    Steps to either side are as likely, and [0, 1) is a circle: densities there and back are the same.
    """
    left = u < 0.5
    u = dr.select(left, 2 * u, 2 * u - 1)
    step = LARGEST * dr.exp(u * dr.log(SMALLEST / LARGEST))
    x = x + dr.select(left, -step, step)
    x -= dr.floor(x)
    # 1 results from a number just below 0, rounded.
    return dr.select(x < 1, x, 0)


def acceptance(f: mi.Float, proposed: mi.Float) -> mi.Float:
    """The probability that a chain at a state of value ``f`` goes on to one of the value ``proposed``."""
    return dr.select(proposed < f, proposed / f, dr.select(proposed > 0, mi.Float(1), 0))


@dataclass
class Proposal:
    """The numbers of a mutation, one after the other; instead of a sampler."""

    vector: dr.Local  # the numbers of the chain's state
    random: mi.PCG32  # one number for each of them
    large: mi.Bool  # all numbers are new, independent of the state's
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
    """The ``vector`` after a mutation: the numbers of ``Proposal`` where it is ``accepted``."""

    def write(i, proposal):
        x = proposal.next_1d()
        proposal.vector.write(x, i, accepted)
        return i + 1, proposal

    state = (mi.UInt32(0), Proposal(vector, mi.PCG32(random), mi.Bool(large), mi.UInt32(0)))
    return dr.while_loop(state, lambda i, _: i < REMEMBERED, write, label="mutation")[1].vector
