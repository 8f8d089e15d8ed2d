"""What is told to be typed installs: messages and pages say the same, and no more than is true today."""

import sys
from pathlib import Path

from ngpt.system import install

ROOT = Path(__file__).parents[2]
EXTRAS = ("render", "export", "train", "cluster", "peers")


def test_a_checkout_is_installed_from_where_it_lies():
    told = install.install_command("render")
    assert told.endswith(f"install -e '{ROOT}[render]'")


def test_the_index_is_named_once_the_package_is_there(monkeypatch):
    monkeypatch.setattr(install, "PUBLISHED", True)
    assert install.install_command("render").endswith("install 'ngpt-recon[render]'")


def test_elsewhere_the_packages_of_the_extra_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr(install, "CHECKOUT", tmp_path)
    told = install.install_command("peers")
    assert "'flip-evaluator>=1.6' 'scikit-image>=0.22'" in told and "ngpt-recon" not in told
    assert all(install.packages_of(extra) for extra in EXTRAS)


def test_pip_is_that_of_this_python(monkeypatch):
    monkeypatch.setattr(install.shutil, "which", lambda name: "/somewhere/else/pip")
    assert install.package_command("onnx") == f"{sys.executable} -m pip install onnx"
    monkeypatch.setattr(install.shutil, "which", lambda name: str(Path(sys.executable).parent / "pip"))
    assert install.package_command("onnx") == "pip install onnx"
