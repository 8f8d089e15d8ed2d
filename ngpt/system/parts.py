"""What other packages bring, by entry points: the renderer, whom nothing in ngpt imports, and the verbs that render."""

from collections.abc import Iterator
from typing import Any

from ngpt.errors import NgptError
from ngpt.system.install import install_command


def no_renderer() -> str:
    """What is missing where nothing renders, and what installs it."""
    return f"rendering needs the package data_gen, which is not installed; `{install_command('render')}`"


def brought(group: str) -> Iterator[Any]:
    """What the entry points of a ``group`` name, without those of packages that are not there any more."""
    from importlib.metadata import entry_points  # takes 50 ms

    for point in entry_points(group=group):
        try:
            yield point.load()
        except ModuleNotFoundError:
            continue


def find_renderer() -> Any:
    """The renderer, see ``ngpt.renderer.Renderer``. Raises NgptError where none is installed."""
    for renderer in brought("ngpt.renderers"):
        return renderer
    raise NgptError(no_renderer())
