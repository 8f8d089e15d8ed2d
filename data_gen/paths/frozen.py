"""Functions whose kernels are recorded once in a render, and only launched in later calls.

Python and Dr.Jit take a second to record the kernel of ``gpt``, however few its samples are. A pass of photons has few
camera samples and many kernels, so most of its time could go into recording. A function is recorded again if its arrays
have other types, if the widths of two arrays become equal or a width becomes 1, or if a scene is loaded or freed in the
process.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Iterable
from typing import Any

import drjit as dr
import mitsuba as mi

from ngpt.errors import stop_if_interrupted

_LOG = logging.getLogger(f"ngpt.{__name__}")


class Frozen:
    """Calls functions: ``frozen(f, *args)`` returns ``f(*args)``, and records the kernels of f in the first call.

    All arrays that f uses must be among its arguments, or belong to the ``scene`` or to attributes of the ``owners``.
    All else that f uses must not change while this object lives. f must not use the width of an array as a number. If f
    cannot be recorded, it is called without recording, and a warning says so. In spectral variants it is never
    recorded.
    """

    def __init__(self, scene: mi.Scene, *owners: Any):
        self.scene, self.state = scene, [scene, *map(arrays, owners), *_of_each_kind()]
        self.functions: dict[Callable, Callable] = {}
        _wake_lamps(scene)
        self.settle = _Recorded(_nothing, self.state)

    def __call__(self, f: Callable, *args: Any, sums: Callable | None = None) -> Any:
        """``sums``, if given, makes the last argument of f, to which f adds.

        A call that fails may already have added to the sums, so each try gets new sums.
        """

        def tried(f: Callable) -> Any:
            return f(*args, *([sums()] if sums else []))

        if mi.is_spectral:
            # Dr.Jit does not find Mitsuba's tables of colours, so all three tries would fail.
            return tried(evaluated(f))
        try:
            if f not in self.functions:
                self.functions[f] = _Recorded(as_wide_as_arguments(f), self.state)
                # Dr.Jit turns each number that it finds into an array. A number that belongs to several objects becomes
                # several arrays in the first call and a single array in the next call, so f would be recorded again. To
                # prevent this, a function that does nothing is called first.
                tried(self.settle)
            return tried(self.functions[f])
        except RuntimeError as error:
            stop_if_interrupted(error)
        try:
            # There may be a new scene in the process.
            _wake_lamps(self.scene)
            tried(self.settle)
            return tried(self.functions[f])
        except RuntimeError as error:
            stop_if_interrupted(error)
            self.functions[f] = evaluated(f)
            result = tried(self.functions[f])
            _say(f, " ".join(str(error.__cause__ or error).split()))
            return result


class _Recorded:
    """A function that ``dr.freeze`` records. ``state`` holds the arrays that it uses besides its arguments.

    ``dr.freeze`` makes a class, which only Python's collector of reference cycles frees. Until then, this class would
    keep everything alive that it refers to, so it has only a weak reference to this object. Otherwise scenes of earlier
    renders would stay in memory. They make kernels larger, and when they are freed, functions are recorded again.
    """

    def __init__(self, f: Callable, state: list):
        self.f, self.state, this = f, state, weakref.ref(self)
        # Some functions are recorded a few times, for example for a map with exactly as many vertices as the image has
        # pixels. This is no reason to warn.
        options = {"warn_after": 1 << 30, "auto_opaque": False, "state_fn": lambda *_: this().state}
        self.launch = dr.freeze(lambda *args: this().f(*args), **options)

    def __call__(self, *args: Any) -> Any:
        return self.launch(*args)


def _nothing(*args: Any) -> None:
    pass


def _of_each_kind() -> list:
    """A pointer of each type. A virtual call uses all objects of its type in the process, but Dr.Jit finds these
    objects only if the function has a pointer of that type. Without it, a material that no shape uses would keep the
    function from being recorded.
    """
    return [dr.zeros(getattr(mi, name)) for name in dir(mi) if name.endswith("Ptr")]


# Functions for which a warning was given
_SAID: set[str] = set()


def _say(f: Callable, reason: str) -> None:
    name = getattr(getattr(f, "func", f), "__qualname__", repr(f))
    if name not in _SAID:
        _SAID.add(name)
        _LOG.warning("%s is recorded again in each pass, which may take a second each time: %s", name, reason)


def _wake_lamps(scene: mi.Scene) -> None:
    """Makes all lamps in the process build the tables by which they are sampled, such as the distribution of a texture.
    Lamps build them on first use, a virtual call uses all lamps, and Dr.Jit cannot record a function in which tables
    are built.
    """
    if scene.emitters():
        scene.emitters_dr().sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), True)


def as_wide_as_arguments(f: Callable) -> Callable:
    """f, but with constant results made to depend on an argument. Dr.Jit 1.5 would keep the width of a constant from
    the first call."""

    def widened(*args: Any) -> Any:
        by_width = {dr.width(leaf): leaf for leaf in leaves(args)}

        def depending(leaf: Any) -> Any:
            width = dr.width(leaf)
            if leaf.state != dr.VarState.Literal or width == 1:
                return leaf
            if width not in by_width:
                raise RuntimeError(f"a constant among the results has width {width}, and no argument has that width")
            return dr.select(_always(by_width[width]), leaf, dr.zeros(type(leaf)))

        return mapped(depending, f(*args))

    return widened


def _always(leaf: Any) -> Any:
    """True in each lane, in a form that Dr.Jit does not recognise as a constant."""
    mask = leaf if dr.is_mask_v(leaf) else leaf == 0
    return (dr.select(mask, dr.uint32_array_t(mask)(1), 2)) > 0


def mapped(f: Callable, value: Any) -> Any:
    """A copy of a tree with f applied to its flat arrays. Objects in the tree are changed in place."""
    if isinstance(value, list | tuple):
        return type(value)(mapped(f, part) for part in value)
    if isinstance(value, dict):
        return {key: mapped(f, part) for key, part in value.items()}
    if dr.is_array_v(value):
        if dr.is_tensor_v(value):
            return type(value)(f(value.array), value.shape)
        if not dr.is_jit_v(value):
            return value
        return f(value) if dr.depth_v(value) == 1 else type(value)(*(mapped(f, part) for part in value))
    for name in fields(value):
        setattr(value, name, mapped(f, getattr(value, name)))
    return value


def leaves(value: Any) -> list:
    """The flat arrays of a tree."""
    if isinstance(value, list | tuple):
        parts = value
    elif isinstance(value, dict):
        parts = value.values()
    elif dr.is_array_v(value):
        if dr.is_tensor_v(value):
            # Iterating over a tensor would slice it, row by row and element by element.
            return [value.array]
        if dr.is_jit_v(value) and dr.depth_v(value) == 1:
            return [value]
        parts = value if dr.is_jit_v(value) else ()
    else:
        parts = [getattr(value, name) for name in fields(value)]
    return [leaf for part in parts for leaf in leaves(part)]


def fields(value: Any) -> Iterable[str]:
    """The names of an object's parts that may hold arrays."""
    of_type = getattr(type(value), "DRJIT_STRUCT", None) or getattr(value, "__dataclass_fields__", None)
    return of_type or (vars(value) if type(value).__module__.startswith("data_gen.") else ())


def call(f: Callable, *args: Any) -> Any:
    """Calls ``f`` without ``Frozen``: it is recorded each time."""
    return f(*args)


def evaluated(f: Callable) -> Callable:
    """f with its results evaluated at once, as ``Frozen`` does. Each further use of a lazy result would trace all
    paths again."""

    def computed(*args: Any) -> Any:
        result = f(*args)
        dr.eval(result)
        return result

    return computed


def arrays(owner: Any) -> list:
    """Replaces the arrays in the attributes of an object, and of the objects in its attributes, by copies. Returns the
    copies.

    Kernels depend on the alignment of their arrays, which varies for arrays of NumPy. Without copies kernels would be
    compiled again.
    """
    found: list = []
    for name, value in list(vars(owner).items()) if hasattr(owner, "__dict__") else ():
        if value is not None and dr.is_jit_v(value):
            setattr(owner, name, dr.opaque(value))
            found.append(getattr(owner, name))
        elif type(value).__module__.startswith("data_gen."):
            found += arrays(value)
    return found
