"""The configurations that come with ngpt, by name, wherever it is installed."""

import os
from pathlib import Path

from ngpt.errors import NgptError, did_you_mean

# They are inside an installed package, and beside the package in the repository.
_PACKAGE = Path(__file__).parents[1]
FOLDER = next((f for f in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if f.is_dir()), _PACKAGE / "configs")

# The prefixes of the names of the three kinds; configurations of training have neither of the other prefixes.
DATASET, EVALUATION, TRAINING = "data-", "eval-", ""
# The configurations that a user's own one starts from by default
STARTS = {DATASET: "data-cpu", EVALUATION: "eval-tiny", TRAINING: "fast"}


def names(kind: str) -> list[str]:
    """The configurations of one kind: ``DATASET``, ``EVALUATION`` or ``TRAINING``."""
    found = sorted(path.stem for path in FOLDER.glob("*.toml"))
    if kind == TRAINING:
        return [name for name in found if not name.startswith((DATASET, EVALUATION))]
    return [name for name in found if name.startswith(kind)]


def find_config(name: str, kind: str) -> Path:
    """The file called ``name``; if there is none, the configuration of that name that comes with ngpt.

    Raises NgptError if there is neither; the message lists the configurations of that kind.
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
