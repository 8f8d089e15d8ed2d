"""The wheel: what it holds and brings. `scripts/wheel.py` installs it with every extra and tries them."""

import re
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

pytest.importorskip("hatchling")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of the working tree."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def held(wheel):
    """The names of its files."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def metadata(wheel, held):
    (name,) = (name for name in held if name.endswith("/METADATA"))
    with zipfile.ZipFile(wheel) as archive:
        return Parser().parsestr(archive.read(name).decode())


def test_it_holds_the_two_packages_and_the_configurations(held):
    files = [path for room in ("ngpt", "data_gen") for path in (ROOT / room).rglob("*") if path.is_file()]
    packages = {path.relative_to(ROOT).as_posix() for path in files if path.parent.name != "__pycache__"}
    configs = {f"ngpt/configs/{path.name}" for path in (ROOT / "configs").iterdir()}
    weights = {f"ngpt/weights/{path.name}" for path in (ROOT / "export" / "weights").iterdir()}
    assert {name for name in held if "dist-info" not in name} == packages | configs | weights
    assert {"ngpt/py.typed", "ngpt/report/report.html"} <= packages
    assert "ngpt/configs/tiny.toml" in configs


def test_it_is_light_without_extras_and_whole_with_train(metadata):
    needs = [
        re.match(r"([\w-]+)(?:\[([\w,]+)\])?[^;]*(?:; extra == '(\w+)')?", n) for n in metadata.get_all("Requires-Dist")
    ]
    base = {"filelock", "mitsuba-oidn", "numpy", "onnxruntime", "openexr", "rich", "scipy"}
    assert {n[1].lower() for n in needs if not n[3]} == base

    def brought(extra):
        ours = [n for n in needs if n[3] == extra]
        further = [brought(other) for n in ours if n[1] == "ngpt-recon" for other in n[2].split(",")]
        return {n[1] for n in ours if n[1] != "ngpt-recon"}.union(*further)

    assert brought("train") == {"mitsuba", "onnx", "onnxscript", "safetensors", "tensorboard", "torch"}
    assert metadata["Description-Content-Type"] == "text/markdown" and "# ngpt" in metadata.get_payload()
