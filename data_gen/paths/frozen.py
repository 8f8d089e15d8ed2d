"""Functions whose kernels are recorded once in a render, and launched again from then on.

Python and Dr.Jit take a second to record the kernel of ``gpt``, however few its samples are, and a pass of photons has
few camera samples and many kernels. A function is recorded again where it meets arrays of other types, where two of its
arrays happen to be of one width, or of width 1, and where scenes come into the process or leave it.
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
    """Calls functions: ``frozen(f, *args)`` is ``f(*args)``, whose kernels are recorded when the types are new.

    All arrays that f uses are among its arguments, or belong to the ``scene``, or to attributes of the ``owners``. All
    else that f uses does not change while this object lives. Within f no width is a number. Where f cannot be recorded
    it is called as it is, and a warning says so; in spectral variants it always is.
    """

    def __init__(self, scene: mi.Scene, *owners: Any):
        self.scene, self.state = scene, [scene, *map(arrays, owners), *_of_each_kind()]
        self.functions: dict[Callable, Callable] = {}
        _wake_lamps(scene)
        self.settle = _Recorded(_nothing, self.state)

    def __call__(self, f: Callable, *args: Any, sums: Callable | None = None) -> Any:
        """``sums`` makes the last argument, which f adds to.

        A call that fails may have added already: the next try has others.
        """

        def tried(f: Callable) -> Any:
            return f(*args, *([sums()] if sums else []))

        if mi.is_spectral:
            # Dr.Jit does not find Mitsuba's tables of colours, and would be asked three times in vain.
            return tried(evaluated(f))
        try:
            if f not in self.functions:
                self.functions[f] = _Recorded(as_wide_as_arguments(f), self.state)
                # Dr.Jit makes an array of each number that it meets, and one that belongs to several objects becomes
                # several arrays, which are one again from the next call on. What does nothing is recorded for that.
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
    """A function that ``dr.freeze`` records, with arrays that it uses beside its arguments.

    ``dr.freeze`` makes a class, which only Python's collector of reference cycles frees. Until then everything that the
    class refers to would live. Scenes of earlier renders make kernels larger, and freeing them has functions recorded
    again.
    """

    def __init__(self, f: Callable, state: list):
        self.f, self.state, this = f, state, weakref.ref(self)
        # Maps with as many vertices as the image has pixels, and similar cases, are recorded once more: no reason to
        # warn.
        options = {"warn_after": 1 << 30, "auto_opaque": False, "state_fn": lambda *_: this().state}
        self.launch = dr.freeze(lambda *args: this().f(*args), **options)

    def __call__(self, *args: Any) -> Any:
        return self.launch(*args)


def _nothing(*args: Any) -> None:
    pass


def _of_each_kind() -> list:
    """A pointer of each type: a call goes through all objects of its kind in the process, and Dr.Jit looks at them only
    if the function is given such a pointer. A material that no shape has would keep the function from being recorded.
    """
    return [dr.zeros(getattr(mi, name)) for name in dir(mi) if name.endswith("Ptr")]


# Functions that a warning has been given for
_SAID: set[str] = set()


def _say(f: Callable, reason: str) -> None:
    name = getattr(getattr(f, "func", f), "__qualname__", repr(f))
    if name not in _SAID:
        _SAID.add(name)
        _LOG.warning("%s is recorded anew in each pass, which may take a second of each: %s", name, reason)


def _wake_lamps(scene: mi.Scene) -> None:
    """Makes all lamps in the process build the tables that they are sampled by, such as the distribution of a texture.
    Lamps build them on first use, and a call uses all lamps. Dr.Jit cannot record a function in which that happens.
    """
    if scene.emitters():
        scene.emitters_dr().sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), True)


def as_wide_as_arguments(f: Callable) -> Callable:
    """f, with constants among its results that depend on an argument: else Dr.Jit 1.5 keeps the width of the first."""

    def widened(*args: Any) -> Any:
        by_width = {dr.width(leaf): leaf for leaf in leaves(args)}

        def depending(leaf: Any) -> Any:
            width = dr.width(leaf)
            if leaf.state != dr.VarState.Literal or width == 1:
                return leaf
            if width not in by_width:
                raise RuntimeError(f"a constant among the results, {width} wide as no argument is")
            return dr.select(_always(by_width[width]), leaf, dr.zeros(type(leaf)))

        return mapped(depending, f(*args))

    return widened


def _always(leaf: Any) -> Any:
    """True, but Dr.Jit does not know that it is constant."""
    mask = leaf if dr.is_mask_v(leaf) else leaf == 0
    return (dr.select(mask, dr.uint32_array_t(mask)(1), 2)) > 0


def mapped(f: Callable, value: Any) -> Any:
    """A tree whose flat arrays are what f makes of them; objects in it are changed in place."""
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
    """Calls ``f``, which is recorded each time."""
    return f(*args)


def evaluated(f: Callable) -> Callable:
    """f, with its results evaluated at once, as frozen functions do it: each use of lazy ones would trace all paths."""

    def computed(*args: Any) -> Any:
        result = f(*args)
        dr.eval(result)
        return result

    return computed


def arrays(owner: Any) -> list:
    """The arrays in the attributes of an object, and of objects there, which become copies.

    Kernels depend on how the memory of arrays is aligned, which varies for arrays of NumPy: kernels would be compiled
    again.
    """
    found: list = []
    for name, value in list(vars(owner).items()) if hasattr(owner, "__dict__") else ():
        if value is not None and dr.is_jit_v(value):
            setattr(owner, name, dr.opaque(value))
            found.append(getattr(owner, name))
        elif type(value).__module__.startswith("data_gen."):
            found += arrays(value)
    return found
