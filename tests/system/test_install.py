"""What is told to be typed installs: messages and pages say the same, and no more than is true today."""

import re
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


@pytest.mark.parametrize(("what", "name"), [(what, names[0]) for what, names in install.BROUGHT.items()])
def test_a_study_that_is_not_installed_is_one_line_with_the_command(monkeypatch, tmp_path, command, what, name):
    monkeypatch.setattr(parts, "points", lambda group: iter(()))
    if what == "network":
        pytest.importorskip("torch")
        from ngpt.network.config import KINDS, ModelConfig

        registry, ask = KINDS, lambda: ModelConfig(name, (4,), (1,), ("primal",))
    elif what == "sampler":
        registry, ask = FRAME_SAMPLERS if name in FRAME_SAMPLERS else SAMPLERS, lambda: find(name)
    else:
        registry, ask = METHODS, lambda: runnable(name)
    monkeypatch.delitem(registry, name, raising=False)
    said = f"{what} '{name}' is of the package ngpt-studies, which is not installed; "
    with pytest.raises(WrongUse, match=rf"^{re.escape(said)}.*pip install -e {ROOT / 'studies'}`$"):
        ask()
    monkeypatch.setattr(install, "PUBLISHED", True)
    monkeypatch.setattr(install, "CHECKOUT", tmp_path)
    with pytest.raises(WrongUse, match=r"pip install ngpt-studies`$"):
        ask()
    if what == "method":
        assert said in command(f"denoise stack.exr -m {name} -o image.exr", 2).err
