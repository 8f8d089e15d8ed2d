"""Imports SciPy at its first use, because the import takes a quarter of a second and most commands do not need it."""

from importlib import import_module
from typing import Any


class Late:
    """Stands for the module ``name``, and imports it when one of its attributes is first used."""

    def __init__(self, name: str):
        self.name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self.name), attribute)


ndimage, fft, sparse = Late("scipy.ndimage"), Late("scipy.fft"), Late("scipy.sparse")
