"""Windows and macOS: to read, write, denoise or lock a folder needs nothing that only POSIX or Linux has.

The tests run here, without what those systems lack (``lesser_system``).
"""

import ast
import ctypes
import os
import re
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from full_stack import full_stack
from processes import ENVIRONMENT, ROOT, temporary_files

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
    """Starts Python on the lesser system, each guessed encoding an error."""
    place = tmp_path / "lesser"
    place.mkdir()
    shutil.copy(ROOT / "tests" / "lesser_system.py", place / "sitecustomize.py")
    command = [sys.executable, "-X", "warn_default_encoding", "-W", "error::EncodingWarning"]
    # A pipe there has the letters of one language.
    known = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(place), str(ROOT)]), "PYTHONIOENCODING": "cp1252"}
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return lambda *words: subprocess.Popen([*command, *map(str, words)], env=known, encoding="cp1252", **streams)


def ended(process, given=""):
    output, errors = process.communicate(given, timeout=120)
    return SimpleNamespace(returncode=process.returncode, stdout=output, stderr=errors)


def unguarded(source: str) -> set[str]:
    """Modules of POSIX that a file imports outside of a ``try`` that goes on without them."""
    tree = ast.parse(source)
    guarded = [
        statement
        for block in ast.walk(tree)
        if isinstance(block, ast.Try) and any("ImportError" in ast.unparse(h.type or block) for h in block.handlers)
        for statement in block.body
    ]
    spared = {node for statement in guarded for node in ast.walk(statement)}
    found = set()
    for node in set(ast.walk(tree)) - spared:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return found & POSIX


def test_modules_of_posix_are_imported_where_they_may_be_missing():
    texts = {
        path: path.read_text(encoding="utf-8") for room in ("ngpt", "data_gen") for path in (ROOT / room).rglob("*.py")
    }
    named = re.compile(rf"\b(?:{'|'.join(POSIX)})\b")
    assert {path: unguarded(text) for path, text in texts.items() if named.search(text) and unguarded(text)} == {}


@pytest.mark.parametrize("options", [["-m", "ngpt-fast"], ["-m", "wcv", "--untrusted"]])
def test_the_same_image(tmp_path, python, options):
    source, out = tmp_path / "noisy.exr", tmp_path / "clean.exr"
    ngpt.write(source, full_stack(40, 56))
    done = ended(python("-m", "ngpt", "denoise", source, "-o", out, *options))
    assert done.returncode == 0, done.stderr
    expected = ngpt.denoise(ngpt.read(source), options[1])
    np.testing.assert_allclose(ngpt.read_image(out), expected, rtol=1e-4, atol=1e-5)
    assert temporary_files(tmp_path) == []


def test_letters_that_the_terminal_lacks(tmp_path, python):
    stack = full_stack(8, 8)
    stack.attributes["scene"] = "Ωmega"
    ngpt.write(tmp_path / "a.exr", stack)
    done = ended(python("-m", "ngpt", "info", tmp_path / "a.exr"))
    assert done.returncode == 0 and "\\u03a9mega" in done.stdout, done.stderr


def test_a_folder_belongs_to_one_process_until_it_is_killed(tmp_path, python):
    with python("-c", LOCK, tmp_path) as holder:
        assert holder.stdout.readline() == "locked\n", holder.stderr.read()
        assert "another process is writing there" in ended(python("-c", LOCK, tmp_path)).stdout
        holder.kill()
        holder.wait()
    after = ended(python("-c", LOCK, tmp_path), "\n")
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
