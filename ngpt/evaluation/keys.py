"""Hashes of code and scenes, for the keys of the cache of an evaluation, so that no table mixes two versions.

The code that renders is hashed by the renderer (``ngpt.renderer``).
"""

import hashlib
import re
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

from ngpt.system.source import code_text, source_hash

# Packages of the library that affect neither images nor numbers.
_PRESENTATION = ("cli", "evaluation", "export", "report", "system")


@lru_cache(maxsize=1)
def library_hash() -> str:
    """A hash of the source and the weights of the library."""
    folder = Path(__file__).parents[1]
    digest = hashlib.sha256(source_hash(folder, _PRESENTATION).encode())
    for path in sorted((folder / "weights").iterdir()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def code_of(function: Any) -> str:
    """The SHA-256 of the package of a function; "" for our own package, whose hash is ``library_hash``."""
    root = getattr(function, "func", function).__module__.partition(".")[0]
    file = getattr(sys.modules.get(root), "__file__", None)
    if root == "ngpt" or not file:
        return ""
    path = Path(file)
    if path.name == "__init__.py":
        return source_hash(path.parent)
    return hashlib.sha256(code_text(path).encode()).hexdigest()


def scene_hash(scene: str) -> str:
    """A hash of a scene's file and of all files it names, directly or through other files."""
    digest = hashlib.sha256()
    queue, seen = [Path(scene)], set()
    while queue:
        path = queue.pop()
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        data = path.read_bytes()
        digest.update(hashlib.sha256(data).digest())
        if path.suffix == ".xml":
            names = sorted(set(re.findall(r'(?:value|filename)="([^"$]+)"', data.decode(errors="replace"))))
            queue += [file for name in names if (file := Path(scene).parent / name).is_file()]
    return digest.hexdigest()


def file_hash(path: str) -> str:
    """A hash of a file's contents; "" if there is no file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path and Path(path).is_file() else ""
