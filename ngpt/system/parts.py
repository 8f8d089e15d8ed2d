"""Finds parts that other packages add by entry points.

Such parts are the renderer, verbs of the command line, and entries of a ``Registry``: methods, samplers, losses,
metrics and networks. Nothing in ngpt imports the renderer directly.
"""

import sys
import traceback
from collections.abc import Container, Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from typing import Any, TypeVar

from ngpt.errors import NgptError, WrongUse, did_you_mean
from ngpt.system.console import print_line
from ngpt.system.install import install_command, study

T = TypeVar("T")


def no_renderer() -> str:
    """The message for a missing renderer, with the command that installs it."""
    return f"rendering needs the package data_gen, which is not installed; `{install_command('render')}`"


def warn(text: str) -> None:
    """Prints a line on standard error about a package that cannot be used; the work goes on without it."""
    print_line(f"ngpt: {text}", sys.stderr)


def points(group: str) -> Iterator[Any]:
    """The entry points of a ``group`` whose packages are still installed. Nothing is imported."""
    for point in _listed(tuple(sys.path)).select(group=group):
        if find_spec(point.module.partition(".")[0]):
            yield point


@cache
def _listed(path: tuple[str, ...]) -> Any:
    """The entry points of all packages on the ``path``. They are cached, because listing them takes 5 ms."""
    from importlib.metadata import entry_points  # takes 50 ms

    return entry_points()


def loaded(point: Any) -> Any:
    """The object that an entry point names. Raises NgptError if its import fails in any way."""
    try:
        return point.load()
    except Exception as error:
        raise NgptError(f"{_owner(point)} cannot be imported: {type(error).__name__}: {error}") from error


def blamed(error: Exception) -> str:
    """An error of another package's function as text, with the last line in the file of that function."""
    frames = traceback.extract_tb(error.__traceback__)[1:]
    last = next((frame for frame in reversed(frames) if frame.filename == frames[0].filename), None)
    where = f" ({last.filename}, line {last.lineno})" if last else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"


def brought(group: str) -> Iterator[Any]:
    """The objects of the entry points of a ``group``. Objects that cannot be imported are left out with a warning."""
    for point in points(group):
        try:
            yield loaded(point)
        except NgptError as error:
            warn(str(error))


def find_renderer() -> Any:
    """The installed renderer (``ngpt.renderer.Renderer``). Raises NgptError if there is none, or it is broken."""
    return _only("ngpt.renderers")


def find_crops() -> Any:
    """The installed ``ngpt.renderer.Crops``. Raises NgptError if there is none, or it is broken."""
    return _only("ngpt.crops")


def _only(group: str) -> Any:
    for point in points(group):
        return loaded(point)
    raise NgptError(no_renderer())


class Registry(dict[str, T]):
    """Entries by name: those of ngpt, and those that other packages bring by entry points of a ``group``.

    An entry of another package is imported when it is requested by name. Iteration leaves out entries that are not
    imported yet; ``load`` imports all.

    ``what``   the word for an entry in messages: "method"
    ``kind``   the class of an entry, or ``Callable``
    ``ours``   the entries of ngpt
    ``taken``  further names that entries of other packages must not have
    """

    def __init__(self, group: str, what: str, kind: Any, ours: dict[str, T], taken: Container[str] = ()):
        super().__init__(ours)
        self.group, self.what, self.kind, self.taken = group, what, kind, taken
        self._imported: set[str] = set()

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or bool(self._called(str(name)))

    def __missing__(self, name: str) -> T:
        named = self._called(name)
        if not named:
            raise KeyError(name)
        if len(named) > 1:
            packages = " and ".join(f"'{point.dist.name}'" for point in named)
            raise NgptError(f"{self.what} '{name}': the packages {packages} both bring one; uninstall one of them")
        entry = loaded(named[0])
        if not isinstance(entry, self.kind) or getattr(entry, "name", name) != name:
            raise NgptError(f"{_owner(named[0])} names {entry!r:.80}, which is no {self.what} of that name")
        self[name] = entry
        self._imported.add(name)
        return entry

    def get(self, name: str, default: Any = None) -> Any:
        try:
            return self[name]
        except KeyError:
            return default

    def names(self) -> list[str]:
        """The names of all entries. Nothing is imported."""
        return list(dict.fromkeys([*self, *(point.name for point in self._others())]))

    def load(self) -> list[str]:
        """Imports the entries of other packages and returns their names. Broken ones are left out with a warning."""
        for point in points(self.group):
            if self._is_taken(point):
                warn(f"{_owner(point)} is left out: ngpt has a {self.what} of that name; its package must rename it")
        for name in dict.fromkeys(point.name for point in self._others()):
            try:
                self[name]
            except NgptError as error:
                warn(str(error))
        return [name for name in self if name in self._imported]

    def unknown(self, name: str, names: Iterable[str], choices: str) -> WrongUse:
        """The error for an unknown name. It says how to install the study of that name, or suggests a similar one of
        ``names`` and lists the ``choices``."""
        if line := study(self.what, name):
            return WrongUse(line)
        return WrongUse(f"unknown {self.what} '{name}'; {did_you_mean(name, names)}choose one of: {choices}")

    def _called(self, name: str) -> list[Any]:
        return [] if name in self.taken else [point for point in self._others() if point.name == name]

    def _others(self) -> list[Any]:
        return [point for point in points(self.group) if not self._is_taken(point)]

    def _is_taken(self, point: Any) -> bool:
        ours = super().__contains__(point.name) and point.name not in self._imported
        return ours or point.name == "auto" or point.name in self.taken


def _owner(point: Any) -> str:
    """An entry point and its package: "ngpt.methods: 'median' of the package 'ngpt-median'"."""
    package = f" of the package '{point.dist.name}'" if point.dist else ""
    return f"{point.group}: '{point.name}'{package}"
