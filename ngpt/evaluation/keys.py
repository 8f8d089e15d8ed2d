"""What the cache of an evaluation is keyed by: code, scenes and versions, so that no table mixes two of them."""

from __future__ import annotations

import ast
import hashlib
import re
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

# Of the library: rooms that decide no image and no number.
_PRESENTATION = ("cli", "evaluation", "export", "report", "system")
# What the built-in scenes are made of.
_BUILT_IN = ("scenes/builtin.py", "scenes/grids.py")
# Of data_gen: files that render nothing. A scene has a key of its own; a procedural one is a scene file by then.
_NOT_RENDERING = ("__main__.py", "choosing", "inspect.py", "dataset", *_BUILT_IN, "scenes/procedural")

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def source_hash(folder: Path, left_out: tuple[str, ...] = ()) -> str:
    """SHA-256 over the Python files in ``folder``, their names and what they do: comments and docstrings do not count.

    ``left_out`` are paths of files and folders in it.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        if not any(name == part or name.startswith(f"{part}/") for part in left_out):
            digest.update(f"{name}\n{_code(path)}\n".encode())
    return digest.hexdigest()


def _code(path: Path) -> str:
    """A file's syntax tree as text, without docstrings."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)


@lru_cache(maxsize=1)
def library_hash() -> str:
    """Of the library's source and weights: a cell of other code is another cell."""
    folder = Path(__file__).parents[1]
    digest = hashlib.sha256(source_hash(folder, _PRESENTATION).encode())
    for path in sorted((folder / "weights").iterdir()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def renderer_hash() -> str:
    """Of the code that renders."""
    return source_hash(_data_gen(), _NOT_RENDERING)


def scene_hash(scene: str) -> str:
    """Of a scene's file and the files it names, those included in turn; of a built-in scene its name and their code."""
    digest = hashlib.sha256()
    if not Path(scene).is_file():
        digest.update("\n".join([scene, *(_code(_data_gen() / file) for file in _BUILT_IN)]).encode())
        return digest.hexdigest()
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
    """Of a file's contents; "" where there is none."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path and Path(path).is_file() else ""


def _data_gen() -> Path:
    """The folder of the package that renders, which is not imported for it: Mitsuba need not be there."""
    spec = find_spec("data_gen")
    assert spec is not None and spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0])
