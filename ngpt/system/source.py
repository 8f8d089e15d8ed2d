"""Hashes Python files, without comments and docstrings, and lists their imports, for the keys of caches."""

import ast
import hashlib
from pathlib import Path

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def source_hash(folder: Path, left_out: tuple[str, ...] = ()) -> str:
    """SHA-256 of the names and the code of the Python files in ``folder``, without comments and docstrings.

    ``left_out`` lists paths of files and folders in ``folder`` that do not count.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        if not any(name == part or name.startswith(f"{part}/") for part in left_out):
            digest.update(f"{name}\n{code_text(path)}\n".encode())
    return digest.hexdigest()


def code_text(path: Path) -> str:
    """The syntax tree of a file as text, without docstrings."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)


def imports(path: Path) -> set[str]:
    """The full names of the modules that a file imports anywhere, and of the names that it imports from them.

    Relative imports, and imports under ``TYPE_CHECKING``, are not listed.
    """
    found: set[str] = set()
    queue: list[ast.AST] = [ast.parse(path.read_bytes())]
    while queue:
        node = queue.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if not node.level and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            queue += node.orelse
        else:
            queue += ast.iter_child_nodes(node)
    return found
