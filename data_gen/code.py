"""The code that a render runs. Its hash is part of the key of cached stacks, so a change of the code makes new stacks.

Starting from the sampler's module and from ``data_gen.render``, which all samplers share, all imports are followed,
including those inside functions. The files are only read and not imported, so Mitsuba need not be installed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from data_gen.samplers import SAMPLERS
from ngpt.system.source import code_text, imports

ROOT = Path(__file__).parent
# ``data_gen.samplers`` imports the registration modules (``about.py``) of all samplers. It is not followed, because a
# render depends only on the ``about.py`` of its own sampler's package, which is added separately.
_REGISTRY, _MACHINERY = "data_gen.samplers", "data_gen.samplers.registry"
# The ``__init__`` of this package only re-exports names of other modules, so it is not followed.
_FACE = "data_gen"
# Modules of the built-in scenes. They are left out, because a scene has its own key.
_BUILT_IN = ("data_gen.scenes.builtin", "data_gen.scenes.grids")


def code(sampler: str) -> str:
    """SHA-256 of the files that a render with the sampler runs, without their comments and docstrings.

    For "auto" these are the files of all samplers that it may choose. For an unknown name they are the files that all
    samplers share.
    """
    return _hash(reached(sampler))


def scene_code(name: str) -> str:
    """SHA-256 of a built-in scene: of its name and of the files that define the built-in scenes."""
    return _hash(_BUILT_IN, name)


def reached(sampler: str) -> list[str]:
    """The sorted names of the modules in data_gen and in the sampler's package that a render with the sampler runs."""
    entries = [SAMPLERS[sampler]] if sampler in SAMPLERS else [s for s in SAMPLERS.values() if s.rank]
    modules = [entry.module for entry in entries if sampler in (entry.name, "auto") and isinstance(entry.module, str)]
    queue, found = ["data_gen.render", _MACHINERY, *modules, *filter(None, map(_entries_of, modules))], set()
    homes = frozenset({_FACE, *(module.partition(".")[0] for module in modules)})
    while queue:
        module = queue.pop()
        if module not in found and module not in (_REGISTRY, _FACE, *_BUILT_IN):
            found.add(module)
            file = _file(module)
            queue += (name for name in _named(file, file.stat().st_mtime_ns, homes) if _file(name).is_file())
    return sorted(found)


def _entries_of(module: str) -> str | None:
    """The module that registers a sampler: the nearest ``about.py`` in the packages above ``module``, or None."""
    while (module := module.rpartition(".")[0]) not in ("", _REGISTRY):
        if _file(about := f"{module}.about").is_file():
            return about
    return None


# ``changed``, the time of the file's last change, is only there so that a changed file is read again.
@lru_cache(maxsize=1024)
def _named(file: Path, changed: int, homes: frozenset[str]) -> frozenset[str]:
    """The names of everything that a file imports from the packages ``homes``, and of all packages above these.

    Some of the names may be functions or classes and not modules.
    """
    parts = [name.split(".") for name in imports(file) if name.partition(".")[0] in homes]
    return frozenset(".".join(words[: i + 1]) for words in parts for i in range(len(words)))


@lru_cache(maxsize=1024)
def _text(file: Path, changed: int) -> str:
    return code_text(file)


def _file(module: str) -> Path:
    """The file of a module of data_gen or of another package; for a package, its ``__init__``."""
    package, *names = module.split(".")
    home = ROOT
    if package != _FACE:
        spec = find_spec(package)
        inside = spec.submodule_search_locations if spec else None
        home = Path(next(iter(inside)) if inside else spec.origin if spec and spec.origin else package)
    path = home.joinpath(*names)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _hash(modules: Iterable[str], name: str = "") -> str:
    digest = hashlib.sha256(name.encode())
    for module in modules:
        file = _file(module)
        digest.update(f"{module}\n{_text(file, file.stat().st_mtime_ns)}\n".encode())
    return digest.hexdigest()
