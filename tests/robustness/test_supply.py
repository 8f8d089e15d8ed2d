"""What we depend on, and the page of what was tried: the scripts beside the project."""

import ast
import json
import runpy
import subprocess
import sys
import urllib.error
from pathlib import Path

import pytest

pytest.importorskip("packaging")

ROOT = Path(__file__).parents[2]


@pytest.fixture
def supply():
    """The functions of scripts/supply.py."""
    return runpy.run_path(str(ROOT / "scripts" / "supply.py"))


class Package:
    """A distribution with some metadata."""

    version = "1.0"

    def __init__(self, **told):
        self.metadata = self
        self.told = {name.replace("_", "-"): value for name, value in told.items()}

    def get(self, name, default=None):
        return self.told.get(name, default)

    def get_all(self, name, default=None):
        return self.told.get(name, default)


@pytest.mark.parametrize(
    ("told", "good"),
    [
        ({"License_Expression": "BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0"}, True),
        ({"License_Expression": "Apache-2.0 AND Apache-2.0 WITH LLVM-exception AND BSL-1.0"}, True),
        ({"License_Expression": "GPL-3.0-only OR MIT"}, True),
        ({"License_Expression": "MIT AND LGPL-2.1-or-later"}, False),
        ({"Classifier": ["Topic :: X", "License :: OSI Approved :: BSD License"]}, True),
        ({"Classifier": ["License :: OSI Approved :: GNU General Public License v3 (GPLv3)"]}, False),
        ({"License": "MIT License\n\nCopyright"}, True),
        ({"License": "My own, see the file"}, False),
        ({}, False),
    ],
)
def test_licences(supply, capsys, told, good):
    assert supply["check_licences"]({"thing": Package(**told)}) is good
    assert ("supply: licence is copyleft or unknown" in capsys.readouterr().out) is not good


def test_licences_that_we_know_more_of_than_the_metadata(supply):
    assert supply["check_licences"]({"openexr": Package()})
    assert not supply["check_licences"]({"openexr": Package(License_Expression="GPL-3.0-only")})


def test_hashes_are_of_the_versions_we_test_with(supply):
    assert supply["check_lock"]({})


def test_a_package_without_a_version_is_named(supply, capsys):
    assert not supply["check_lock"]({"newcomer": Package()})
    assert "newcomer has no version in constraints.txt" in capsys.readouterr().out


class Answer:
    def __init__(self, value):
        self.value = value

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self):
        return json.dumps(self.value).encode()


def test_vulnerabilities(supply, capsys, monkeypatch):
    check, packages = supply["check_vulnerabilities"], {"thing": Package()}
    flaw = {"id": "PYSEC-1", "fixed_in": ["1.1"], "withdrawn": None}
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: Answer({"vulnerabilities": [flaw]}))
    assert not check(packages) and "thing 1.0: PYSEC-1, fixed in 1.1" in capsys.readouterr().out
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: Answer({"vulnerabilities": []}))
    assert check(packages) and "1 of 1 packages asked for, 0 known" in capsys.readouterr().out

    def nobody(*_, **__):
        raise urllib.error.URLError("no route")

    monkeypatch.setattr("urllib.request.urlopen", nobody)
    assert check(packages) and "vulnerabilities NOT checked" in capsys.readouterr().out


def test_no_code_unpickles_or_reaches_out():
    """What SECURITY.md promises, of our own code."""
    suspect = {"pickle", "marshal", "shelve", "urllib", "http", "requests", "socket", "ftplib"}
    # What `ngpt render --live` and `--view` ask for: a page on the loopback address, and a viewer that is named.
    asked_for = {"ngpt/report/live.py": {"http", "socket"}, "ngpt/report/tev.py": {"socket"}}
    files = [ROOT / "train.py", ROOT / "eval.py"]
    for folder in ("ngpt", "data_gen"):
        files += (ROOT / folder).rglob("*.py")
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                # Which takes text apart, and reaches nothing.
                names = {(node.module or "").partition(".")[0]} if node.module != "urllib.parse" else set()
            elif isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("eval", "exec", "compile"), f"{path}: {ast.unparse(node)}"
                if called in ("torch.load", "np.load"):
                    assert "weights_only=True" in ast.unparse(node), f"{path}: {ast.unparse(node)}"
                continue
            else:
                continue
            found = (names & suspect) - asked_for.get(path.relative_to(ROOT).as_posix(), set())
            assert not found, f"{path}: {found}"


def test_the_page_tells_every_campaign(tmp_path):
    record = {"tried": 3, "worst": {"MiB": 2}, "seconds": 7, "versions": {"numpy": "9"}}
    for name, outcomes in (("Zeros", {"fine": 3}), ("Ones", {"fine": 1, "one line": 2, "lost": 0})):
        (tmp_path / f"{name}.json").write_text(json.dumps(record | {"campaign": name, "outcomes": outcomes}))
    page = tmp_path / "page.md"
    command = [sys.executable, ROOT / "scripts" / "reliability.py", "--from", tmp_path, "-o", page]
    subprocess.run(command, check=True, capture_output=True)
    text = page.read_text()
    assert "6 trials in 2 campaigns" in text and "numpy 9" in text
    assert "| Ones | 3 | 1 fine; 2 one line | MiB: 2 | 7 |\n| Zeros | 3 | 3 fine | MiB: 2 | 7 |" in text
    (tmp_path / "empty").mkdir()
    command[3] = tmp_path / "empty"
    assert subprocess.run(command, capture_output=True, check=False).returncode == 1
