"""The gradient stack: the layers of a rendering, which reconstructions read."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ngpt.errors import NgptError, did_you_mean
from ngpt.image.notebook import stack_html
from ngpt.layers import LAYERS
from ngpt.subpixels import check
from ngpt.windows import Place


@dataclass(eq=False, repr=False)
class GradientStack(Mapping[str, np.ndarray]):
    """The layers of one rendering, scene-linear, with row 0 at the top: a mapping from names to arrays.

    ``layers``      names of the contract (``ngpt.layers.LAYERS``) -> C-contiguous float32 arrays (H, W, C), where C is
                    the number of channels of the layer. Arrays of any real type and memory layout may be passed, and
                    (H, W) if C is 1. They are converted, copied only if necessary, and never modified
    ``attributes``  header attributes that OpenEXR itself does not need, such as ``ngpt:spp``
    ``source``      the file that the stack was read from (``ngpt.io.layout.StackSource``), with its other channels
    ``path``        the name of the stack in messages
    ``place``       the place of the pixels in the whole picture; without it, they are the whole picture
    ``fine``        layers of subpixels, if there are any (``ngpt.subpixels``)

    All float values are legal, including NaN and Inf. Variances stay in double precision if float32 cannot hold them,
    as for light of 1e30 or 1e-30. The last column of dx and the last row of dy are unused and not changed.

    Raises NgptError for unknown layers, types that are not real numbers, wrong shapes, layers of different sizes,
    images without pixels, and finite numbers that float32 cannot hold.
    """

    layers: dict[str, np.ndarray]
    attributes: dict[str, Any] = field(default_factory=dict)
    source: Any = None
    path: str = "stack"
    place: Place = None  # type: ignore[assignment]
    fine: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.layers:
            raise NgptError(f"{self.path}: a stack needs at least one layer; pass primal=...")
        self.layers = {name: _as_layer(name, array, self.path) for name, array in self.layers.items()}
        self.attributes = dict(self.attributes)
        first = "primal" if "primal" in self.layers else next(iter(self.layers))
        for name, array in self.layers.items():
            _check_size(self.path, name, array.shape, first, self.layers[first].shape)
        if self.place is None or self.place.data.size != (self.width, self.height):
            self.place = Place.whole(self.width, self.height)
        check(self.fine, self.width, self.height, self.path)

    @classmethod
    def from_arrays(
        cls, *, attributes: Mapping[str, Any] | None = None, path: str = "stack", **layers: ArrayLike
    ) -> "GradientStack":
        """Makes a stack from arrays: ``GradientStack.from_arrays(primal=image, dx=dx, dy=dy)``."""
        return cls({name: np.asarray(array) for name, array in layers.items()}, dict(attributes or {}), path=path)

    @classmethod
    def from_aovs(
        cls, tensor: ArrayLike, names: Sequence[str], attributes: Mapping[str, Any] | None = None
    ) -> "GradientStack":
        """Makes a stack from the tensor (H, W, channels) that ``mi.render(scene)`` returns for an integrator of ngpt.

        ``names`` are the integrator's ``aov_names()``, one for each channel, such as "primal.R". Raises NgptError if
        the number of names differs from the number of channels, for unknown layers, and for layers with missing
        channels.
        """
        array = np.asarray(tensor)
        if array.ndim != 3 or array.shape[2] != len(names):
            found = f"the tensor has shape {array.shape} and there are {len(names)} names"
            raise NgptError(f"{found}; give the tensor of mi.render() and the integrator's aov_names() after it")
        place = {name: i for i, name in enumerate(names)}
        layers = {}
        for name in dict.fromkeys(name.partition(".")[0] for name in names):
            _check_name(name, "AOVs")
            channels = [f"{name}.{channel}" for channel in LAYERS[name].channels]
            if lacking := [channel for channel in channels if channel not in place]:
                raise NgptError(f"AOVs: layer '{name}' lacks {', '.join(lacking)}")
            layers[name] = array[..., [place[channel] for channel in channels]]
        return cls(layers, dict(attributes or {}))

    # Stacks are compared by identity, not as mappings, because comparisons of arrays have no single truth value.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @property
    def height(self) -> int:
        return next(iter(self.layers.values())).shape[0]

    @property
    def width(self) -> int:
        return next(iter(self.layers.values())).shape[1]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the layers, in the order of the contract."""
        return tuple(name for name in LAYERS if name in self.layers)

    def __contains__(self, name: object) -> bool:
        return name in self.layers

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.layers)

    def get(self, name: str, default: Any = None) -> Any:
        """The layer ``name``, or ``default`` if the stack does not have it."""
        return self.layers.get(name, default)

    def __repr__(self) -> str:
        return f"<{self._title}: {', '.join(self.names)}>"

    def _repr_html_(self) -> str:
        """HTML for notebooks: a small picture of the primal and a table of all layers."""
        return stack_html(self._title, {name: self.layers[name] for name in self.names})

    @property
    def _title(self) -> str:
        samples = f", {self.attributes['ngpt:spp']} spp" if "ngpt:spp" in self.attributes else ""
        return f"GradientStack {self.path}, {self.width}x{self.height}{samples}"

    def number(self, attribute: str) -> float | None:
        """An attribute as a finite number; None if it is missing or has another type."""
        value = self.attributes.get(attribute)
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            return None
        number = float(value)
        return number if abs(number) < np.inf else None

    def __getitem__(self, name: str) -> np.ndarray:
        """The layer ``name``. Raises NgptError if the stack does not have it."""
        if name not in self.layers:
            self.require(name)
        return self.layers[name]

    def require(self, *names: str, why: str = "") -> None:
        """Raises NgptError unless the stack has all these layers. ``why`` says what needs them: "method 'l1'"."""
        missing = [name for name in names if name not in self.layers]
        for name in missing:
            _check_name(name, self.path)
        if missing:
            needs = f"{why} needs" if why else "no"
            what = f"layer{'s' if len(missing) > 1 else ''} {' and '.join(repr(name) for name in missing)}"
            remedy = "if the file has it under another name, pass "
            remedy += " ".join(f"--layer {name}=NAME" for name in missing)
            if "primal_var" in missing:
                remedy += "; if its renderer writes none, several seeds do: 'With variances' in from-your-renderer.md"
            if {"dx", "dy"} & {*missing} and "ngpt:sampler" in self.attributes:
                by = self.attributes["ngpt:sampler"]
                remedy = f"sampler {by} renders no gradients: `ngpt render --sampler gpt` does"
            raise NgptError(f"{self.path}: {needs} {what}; the stack holds {', '.join(self.names)}; {remedy}")

    def replace(self, **layers: ArrayLike) -> "GradientStack":
        """A stack with these layers replaced or added, and the same attributes, source and place.

        If a layer with subpixels is replaced, the result has no subpixels, since they belong to the old layer.
        """
        new = {name: np.asarray(array) for name, array in layers.items()}
        fine = {} if self.fine.keys() & new.keys() else self.fine
        return GradientStack({**self.layers, **new}, self.attributes, self.source, self.path, self.place, fine)


# If the largest variance is below this, float32 would lose digits of variances that are 2^40 times smaller.
_DIM = 2.0**-86


def _check_name(name: str, path: str) -> None:
    if name not in LAYERS:
        meant = did_you_mean(str(name), LAYERS)
        raise NgptError(f"{path}: no layer is called '{name}'; {meant}the layers are {', '.join(LAYERS)}")


def _as_layer(name: str, array: ArrayLike, path: str) -> np.ndarray:
    """The array as (H, W, C) float32, C-contiguous; variances as float64 if float32 cannot hold them."""
    _check_name(name, path)
    given = np.asarray(array)
    channels = len(LAYERS[name].channels)
    if given.dtype.kind not in "fiu":
        raise NgptError(f"{path}: layer '{name}' is of type {given.dtype}; convert it to float32")
    if given.ndim == 2 and channels == 1:
        given = given[..., np.newaxis]
    if given.ndim != 3 or given.shape[2] != channels:
        raise NgptError(f"{path}: layer '{name}' has shape {given.shape}; it must be (height, width, {channels})")
    if given.size == 0:
        raise NgptError(f"{path}: layer '{name}' is {given.shape[1]}x{given.shape[0]}; it has no pixels to work on")
    with np.errstate(over="ignore"):
        layer = np.ascontiguousarray(given, dtype=np.float32)
    if name.endswith("_var") and given.dtype.itemsize > 4:
        largest = np.abs(given[np.isfinite(given)]).max(initial=0)
        if largest > np.finfo(np.float32).max or 0 < largest < _DIM:
            return np.ascontiguousarray(given, dtype=np.float64)
    if given.dtype.itemsize > 4:
        lost = np.isfinite(given) & ~np.isfinite(layer)
        if lost.any():
            raise NgptError(
                f"{path}: layer '{name}' has {np.count_nonzero(lost)} values that float32 cannot hold "
                f"(up to {np.abs(given[lost]).max():.3g}, the limit is 3.4e38); scale the scene's light down"
            )
    return layer


def _check_size(path: str, name: str, shape: tuple[int, ...], first: str, expected: tuple[int, ...]) -> None:
    """Raises NgptError if the size of layer ``name`` differs from that of the layer ``first``."""
    (height, width), (rows, columns) = shape[:2], expected[:2]
    if (height, width) == (rows, columns):
        return
    remedy = "render or crop all layers of a stack to one size"
    if name == "dx" and (height, width) == (rows, columns - 1):
        remedy = "gradients are stored at image size with an unused last column: pad it with zeros"
    elif name == "dy" and (height, width) == (rows - 1, columns):
        remedy = "gradients are stored at image size with an unused last row: pad it with zeros"
    raise NgptError(f"{path}: layer '{name}' is {width}x{height} but '{first}' is {columns}x{rows}; {remedy}")
