"""What is told to be typed installs: messages and pages say the same, and no more than is true today."""

import sys
from pathlib import Path

import pytest

from ngpt.system import install

ROOT = Path(__file__).parents[2]


def test_a_checkout_is_installed_from_where_it_lies_and_a_package_by_its_name(monkeypatch, tmp_path):
    assert install.install_command("render").endswith(f"install -e '{ROOT}[render]'")
    monkeypatch.setattr(install, "CHECKOUT", tmp_path)
    told = install.install_command("peers")
    assert "'flip-evaluator>=1.6' 'scikit-image>=0.22'" in told and "ngpt-recon" not in told
    assert all(install.packages_of(extra) for extra in ("render", "export", "train", "cluster", "peers"))
    monkeypatch.setattr(install, "PUBLISHED", True)
    assert install.install_command("render").endswith("install 'ngpt-recon[render]'")


@pytest.mark.parametrize(
    ("pip", "command"),
    [
        ("/somewhere/else/pip", f"{sys.executable} -m pip install onnx"),
        (str(Path(sys.executable).parent / "pip"), "pip install onnx"),
    ],
)
def test_pip_is_that_of_this_python(monkeypatch, pip, command):
    monkeypatch.setattr(install.shutil, "which", lambda name: pip)
    assert install.package_command("onnx") == command
