"""What Python files do, without what is written about it: what caches are keyed by."""

import ast
import hashlib
from pathlib import Path

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def source_hash(folder: Path, left_out: tuple[str, ...] = ()) -> str:
    """SHA-256 over the Python files in ``folder``, their names and what they do: comments and docstrings do not count.

    ``left_out`` are paths of files and folders in it.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        if not any(name == part or name.startswith(f"{part}/") for part in left_out):
            digest.update(f"{name}\n{code_text(path)}\n".encode())
    return digest.hexdigest()


def code_text(path: Path) -> str:
    """A file's syntax tree as text, without docstrings."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)
