"""Functions whose kernels are recorded once in a render, and launched again from then on.

A pass of photons has few camera samples and many kernels. To record them, and to find that they are known, would take
longer than to run them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from ngpt.errors import stop_if_interrupted


class Frozen:
    """Calls functions: ``frozen(f, *args)`` is ``f(*args)``, whose kernels are recorded when the types are new.

    All arrays that f uses are among its arguments, or belong to the ``scene``, or to attributes of the ``owners``. All
    else that f uses does not change while this object lives. Within f nothing is evaluated, no width is a number.
    """

    def __init__(self, scene: mi.Scene, *owners: Any):
        self.state = [scene, *map(arrays, owners)]
        self.functions: dict[Callable, Callable] = {}

    def __call__(self, f: Callable, *args: Any, fixed: bool = False, sums: Callable | None = None) -> Any:
        """``fixed``: all calls of f have arrays of the same widths. ``sums`` makes the last argument, which f adds to.

        A call that fails may have added already: the next try has others.
        """
        if f not in self.functions:
            # Not bound to ``self``: what is in no circle goes when the render does.
            state = self.state
            # Maps of as many vertices as there are pixels, and the like, are recorded once more: no reason to warn.
            options = {"state_fn": lambda *_: state, "warn_after": 1 << 30, "auto_opaque": False}
            self.functions[f] = dr.freeze(f if fixed else without_constants(f), **options)
        try:
            return self.functions[f](*args, *([sums()] if sums else []))
        except RuntimeError as error:
            stop_if_interrupted(error)
            # Dr.Jit 1.5 does not find what lies behind two calls of objects, as the texture of a lamp does, be it of
            # another scene. It records anew where scenes come and go, so this may be later than at the first call.
            self.functions[f] = f
            return f(*args, *([sums()] if sums else []))


def without_constants(f: Callable) -> Callable:
    """f, which must not return a constant for an array: Dr.Jit 1.5 keeps its width of the call that was recorded."""

    def checked(*args: Any) -> Any:
        result = f(*args)
        if any(leaf.state == dr.VarState.Literal and dr.width(leaf) > 1 for leaf in leaves(result)):
            raise RuntimeError("a constant among the results")
        return result

    return checked


def leaves(value: Any) -> Iterator:
    """The flat arrays of a tree."""
    if isinstance(value, list | tuple):
        parts = value
    elif dr.is_array_v(value):
        parts = value if dr.depth_v(value) > 1 else ()
        if dr.is_jit_v(value) and dr.depth_v(value) == 1:
            yield value
    else:
        names = getattr(type(value), "DRJIT_STRUCT", None) or getattr(value, "__dataclass_fields__", ())
        parts = [getattr(value, name) for name in names]
    for part in parts:
        yield from leaves(part)


def call(f: Callable, *args: Any, fixed: bool = False) -> Any:
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
