"""Small arrays that tests render once and keep, such as blocks of images by whole paths.

A test that does not find its array renders it, as slow tests do. With ``NGPT_KEEP=1`` it also adds it to the file.
"""

import os
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np
from references import key

STORE = Path(__file__).with_name("rendered_once.npz")


def rendered_once(description, size, what, render):
    """The array that ``render`` once returned for this scene, or that it returns now."""
    name = key(mi, description, size, what)
    if name in stored():
        return stored()[name].astype(np.float64)
    made = render()
    if os.environ.get("NGPT_KEEP"):
        stored()[name] = made.astype(np.float32)
        np.savez_compressed(STORE, **stored())
    return made


@cache
def stored():
    if not STORE.exists():
        return {}
    with np.load(STORE) as file:
        return dict(file)
