"""Windows and macOS: nothing that POSIX or Linux alone has is needed to read, write, denoise or keep a folder.

Not run there: run here, with what they lack taken away (``lesser_system``).
"""

import ast
import ctypes
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from full_stack import full_stack
from processes import ENVIRONMENT, ROOT, one_error, temporary_files

import ngpt
from ngpt.system import files, limits

POSIX = {"crypt", "fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}

LOCK = """
import sys
from ngpt.errors import NgptError
from ngpt.system.files import exclusive
try:
    with exclusive(sys.argv[1]):
        print("locked", flush=True)
        input()
except NgptError as error:
    print(error)
"""


@pytest.fixture
def python(tmp_path):
    """The beginning of a command, and its environment: Python on the lesser system, each guessed encoding an error."""
    place = tmp_path / "lesser"
    place.mkdir()
    shutil.copy(ROOT / "tests" / "lesser_system.py", place / "sitecustomize.py")
    command = [sys.executable, "-X", "warn_default_encoding", "-W", "error::EncodingWarning"]
    path = os.pathsep.join([str(place), ENVIRONMENT["PYTHONPATH"]])
    # A pipe there has the letters of one language.
    return command, ENVIRONMENT | {"PYTHONPATH": path, "PYTHONIOENCODING": "cp1252"}


def run(python, *arguments):
    command, environment = python
    return subprocess.run(
        [*command, *map(str, arguments)], env=environment, capture_output=True, encoding="cp1252", timeout=120
    )


def unguarded(source: str) -> set[str]:
    """Modules of POSIX that a file imports outside of a ``try`` that goes on without them."""
    tree = ast.parse(source)
    spared = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.Try) and any("ImportError" in ast.unparse(h.type or block) for h in block.handlers)
        for statement in block.body
        for node in ast.walk(statement)
    }
    found = set()
    for node in ast.walk(tree):
        if id(node) not in spared:
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(node.module or "")
    return found & POSIX


def test_modules_of_posix_are_imported_where_they_may_be_missing():
    wrong = {
        str(path): names
        for room in ("ngpt", "data_gen")
        for path in (ROOT / room).rglob("*.py")
        if (names := unguarded(path.read_text(encoding="utf-8")))
    }
    assert not wrong
    assert unguarded("import os, fcntl") == unguarded("def f():\n    from fcntl import flock") == {"fcntl"}
    assert not unguarded("try:\n    import fcntl\nexcept ImportError:\n    fcntl = None")


@pytest.mark.parametrize("options", [["-m", "ngpt-fast"], ["-m", "wcv", "--untrusted"]])
def test_the_same_image(tmp_path, python, options):
    source, out = tmp_path / "noisy.exr", tmp_path / "clean.exr"
    ngpt.write(source, full_stack(40, 56))
    done = run(python, "-m", "ngpt", "denoise", source, "-o", out, *options)
    assert done.returncode == 0, done.stderr
    expected = ngpt.denoise(ngpt.read(source), options[1])
    np.testing.assert_allclose(ngpt.read_image(out), expected, rtol=1e-4, atol=1e-5)
    assert temporary_files(tmp_path) == []
    again = run(python, "-m", "ngpt", "denoise", source, "-o", out, *options)
    assert again.returncode == 1 and "exists already" in again.stderr and one_error(again.stderr)


def test_letters_that_the_terminal_lacks(tmp_path, python):
    source = tmp_path / "a.exr"
    stack = full_stack(8, 8)
    stack.attributes["scene"] = "Ωmega"
    ngpt.write(source, stack)
    done = run(python, "-m", "ngpt", "info", source)
    assert done.returncode == 0 and "\\u03a9mega" in done.stdout, done.stderr


def test_a_folder_belongs_to_one_process_until_it_is_killed(tmp_path, python):
    command, environment = python
    arguments = [*command, "-c", LOCK, str(tmp_path)]
    with subprocess.Popen(
        arguments, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "locked\n", holder.stderr.read()
        assert "another process is writing there" in run(python, "-c", LOCK, tmp_path).stdout
        holder.kill()
        holder.wait()
        after = subprocess.run(arguments, env=environment, input="\n", capture_output=True, text=True, timeout=60)
    assert after.stdout == "locked\n" and after.stderr == "", after


def test_old_temporary_files_are_swept_where_none_can_be_locked(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "fcntl", None)
    old, young = tmp_path / ".ngpt-abcd0123.exr", tmp_path / ".ngpt-wxyz4567.exr"
    for path in (old, young):
        path.write_text("half")
    two_days_ago = old.stat().st_mtime - 2 * 24 * 3600
    os.utime(old, (two_days_ago, two_days_ago))
    with files.atomic_output(tmp_path / "a.txt") as temporary:
        temporary.write_text("done")
    assert sorted(os.listdir(tmp_path)) == [young.name, "a.txt"]


def test_memory_where_only_windows_tells(monkeypatch):
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(limits, "resource", None)
    assert limits.memory() == limits._ASSUMED

    def installed(pointer):
        pointer._obj.value = 3 * 2**20
        return 1

    kernel = SimpleNamespace(GetPhysicallyInstalledSystemMemory=installed)
    monkeypatch.setattr(ctypes, "windll", SimpleNamespace(kernel32=kernel), raising=False)
    assert limits.memory() == 3 * 2**30
