"""Finds the configurations that come with ngpt by their names."""

import os
from pathlib import Path

from ngpt.errors import NgptError, did_you_mean

# The configurations are inside the package if it is installed, and beside the package in the repository.
_PACKAGE = Path(__file__).parents[1]
FOLDER = next((f for f in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if f.is_dir()), _PACKAGE / "configs")

# The prefixes of the names of configurations, by kind; names for training have neither of the other prefixes.
DATASET, EVALUATION, TRAINING = "data-", "eval-", ""
# The configurations that --init writes by default
STARTS = {DATASET: "data-cpu", EVALUATION: "eval-tiny", TRAINING: "fast"}


def names(kind: str) -> list[str]:
    """The names of the configurations of one kind: ``DATASET``, ``EVALUATION`` or ``TRAINING``."""
    found = sorted(path.stem for path in FOLDER.glob("*.toml"))
    others = {DATASET, EVALUATION} - {kind}
    return [name for name in found if name.startswith(kind) and not name.startswith(tuple(others))]


def find_config(name: str, kind: str) -> Path:
    """The file called ``name``, or else the configuration of that name and ``kind`` that comes with ngpt.

    Raises NgptError if there is neither.
    """
    if os.path.exists(name) and not os.path.isdir(name):
        return Path(name)
    stem, known = name.removesuffix(".toml"), names(kind)
    if stem in known:
        return FOLDER / f"{stem}.toml"
    if os.path.isdir(name):
        raise NgptError(f"{name}: is a directory; name a file in it, or one of: {', '.join(known)}")
    meant = did_you_mean(stem, known)
    raise NgptError(f"{name}: cannot be read: no such file; {meant}ngpt has the configurations: {', '.join(known)}")
