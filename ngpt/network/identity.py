"""Identifies the network in a file by the file's contents, not by its name."""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.network.shipped import WEIGHTS
from ngpt.system.reading import regular_file


@dataclass(frozen=True)
class Identity:
    """The identity of a file of weights.

    ``file``     its name, without the folder
    ``sha256``   the hash of its contents, 64 hexadecimal digits
    ``shipped``  the method whose shipped file has the same bytes; "" if there is none
    """

    file: str
    sha256: str
    shipped: str

    def __str__(self) -> str:
        return f"{self.file} sha256:{self.sha256[:12]}"

    @property
    def method(self) -> str:
        """The name of the method in results: a method of ngpt, or "own network FILE" if the network is not shipped."""
        return self.shipped or f"own network {self.file}"


def identify(path: str | Path) -> Identity:
    """The identity of a file of weights. Raises NgptError if the file cannot be read."""
    try:
        with regular_file(Path(path)):
            digest = _digest(str(path), Path(path).stat().st_mtime_ns)
        ours = {_digest(str(own), own.stat().st_mtime_ns): own.stem for own in sorted(WEIGHTS.glob("*.onnx"))}
    except OSError as error:
        raise NgptError(f"{path}: cannot be read: {error.strerror}") from error
    return Identity(Path(path).name, digest, ours.get(digest, ""))


@lru_cache(maxsize=32)
def _digest(path: str, _modified: int) -> str:
    """The SHA-256 of a file; computed again after the file has changed."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
