"""Functions whose kernels are recorded once in a render, and launched again from then on.

A pass of photons has few camera samples and many kernels. To record them, and to find that they are known, would take
longer than to run them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


class Frozen:
    """Calls functions: ``frozen(f, *args)`` is ``f(*args)``, whose kernels are recorded when the types are new.

    All arrays that f uses are among its arguments, or belong to the ``scene``, or to attributes of the ``owners``. All
    else that f uses does not change while this object lives. Within f nothing is evaluated, no width is a number.
    """

    def __init__(self, scene: mi.Scene, *owners: Any):
        self.state = [scene, *map(arrays, owners)]
        self.functions: dict[Callable, Callable] = {}

    def __call__(self, f: Callable, *args: Any) -> Any:
        if f not in self.functions:
            # Not bound to ``self``: what is in no circle goes when the render does.
            state = self.state
            # Maps of as many vertices as there are pixels, and the like, are recorded once more: no reason to warn.
            self.functions[f] = dr.freeze(f, state_fn=lambda *_: state, warn_after=1 << 30, auto_opaque=False)
        try:
            return self.functions[f](*args)
        except RuntimeError:
            # Dr.Jit 1.5 does not find what lies behind two calls of objects, as the texture of a lamp does, be it of
            # another scene. It records anew where scenes come and go, so this may be later than at the first call.
            self.functions[f] = f
            return f(*args)


def call(f: Callable, *args: Any) -> Any:
    """The same, recorded each time."""
    return f(*args)


def arrays(owner: Any) -> list:
    """The arrays in the attributes of an object, and of objects there."""
    found: list = []
    for value in vars(owner).values() if hasattr(owner, "__dict__") else ():
        if value is not None and dr.is_jit_v(value):
            found.append(value)
        elif type(value).__module__.startswith("data_gen."):
            found += arrays(value)
    return found
