"""What is told to be typed installs: messages and pages say the same, and no more than is true today."""

import sys
import tomllib
from pathlib import Path

import pytest

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, find
from ngpt.errors import WrongUse
from ngpt.methods import METHODS, runnable
from ngpt.system import install, parts

ROOT = Path(__file__).parents[2]


def test_a_checkout_is_installed_from_where_it_lies_and_a_package_by_its_name(monkeypatch, tmp_path):
    assert install.install_command("render").endswith(f"install -e '{ROOT}[render]'")
    monkeypatch.setattr(install, "CHECKOUT", tmp_path)
    told = install.install_command("peers")
    assert "'flip-evaluator>=1.6' 'scikit-image>=0.22'" in told and "ngpt-recon" not in told
    assert all(install.packages_of(extra) for extra in ("render", "export", "train", "cluster", "peers"))
    monkeypatch.setattr(install, "PUBLISHED", True)
    assert install.install_command("render").endswith("install 'ngpt-recon[render]'")


STUDIES = tomllib.loads((ROOT / "studies" / "pyproject.toml").read_text())["project"]


def test_studies_are_those_of_their_package():
    groups = {"method": ("methods",), "network": ("networks",), "sampler": ("samplers", "frame_samplers")}
    points = {group.removeprefix("ngpt."): set(names) for group, names in STUDIES["entry-points"].items()}
    found = {what: set.union(*(points.pop(group) for group in some)) for what, some in groups.items()}
    assert found == {what: {*names} for what, names in install.BROUGHT.items()}
    assert not points and STUDIES["name"] == install.STUDIES


def ask_for(what, name):
    """The registry, and a call that asks for an entry of that name."""
    if what == "method":
        return METHODS, lambda: runnable(name)
    if what == "sampler":
        return FRAME_SAMPLERS if name in FRAME_SAMPLERS else SAMPLERS, lambda: find(name)
    pytest.importorskip("torch")
    from ngpt.network.config import KINDS, ModelConfig

    return KINDS, lambda: ModelConfig(name, (4,), (1,), ("primal",))


@pytest.mark.parametrize(("what", "name"), [(what, name) for what, names in install.BROUGHT.items() for name in names])
def test_a_study_that_is_not_installed_is_one_line_with_the_command(monkeypatch, tmp_path, command, what, name):
    registry, ask = ask_for(what, name)
    monkeypatch.setattr(parts, "points", lambda group: iter(()))
    monkeypatch.delitem(registry, name, raising=False)

    def told():
        with pytest.raises(WrongUse) as raised:
            ask()
        line = str(raised.value)
        assert line.startswith(f"{what} '{name}' is of the package ngpt-studies, which is not installed; ")
        return line

    assert told().endswith(f"pip install -e {ROOT / 'studies'}`")
    if what == "method":
        (line,) = command(f"denoise stack.exr -m {name} -o image.exr", 2).err.splitlines()
        assert line == f"ngpt: error: {told()}"
    monkeypatch.setattr(install, "CHECKOUT", tmp_path)
    assert told().endswith("in a checkout of ngpt, `pip install -e studies`".replace("pip", install._pip()))
    monkeypatch.setattr(install, "PUBLISHED", True)
    assert told().endswith("pip install ngpt-studies`")


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
