"""Versions by rule, and what a release is made of: the changelog, the recipe, the workflows, and the extras tried."""

import re
import tomllib
from pathlib import Path

import pytest

from scripts.release import __main__ as release
from scripts.release import rules

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = (ROOT / "scripts" / "release" / "conda" / "recipe.yaml").read_text()
# What the recipe calls otherwise, and what conda's channel lacks, where `auto` does without.
CONDA, LACKING = {"openexr": "openexr-python"}, {"mitsuba-oidn"}


def test_the_changelog_begins_with_this_version():
    headings = re.findall(r"^## (\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d|unreleased)\)$", _changelog(), re.M)
    assert len(headings) == len(re.findall(r"^## ", _changelog(), re.M))
    versions = [tuple(map(int, version.split("."))) for version, _ in headings]
    assert headings[0][0] == rules.version() and versions == sorted(versions, reverse=True)
    assert [date for _, date in headings[1:] if date == rules.UNRELEASED] == []


def _changelog():
    return (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize(
    ("tag", "heading", "cited", "complaint"),
    [
        ("v1.2.0", "## 1.2.0 (2026-12-31)", "1.2.0", None),
        ("1.2.0", "## 1.2.0 (2026-12-31)", "1.2.0", "the tag must be v1.2.0"),
        ("v1.2.0", "## 1.1.0 (2026-12-31)", "1.2.0", "CHANGELOG.md begins with 1.1.0"),
        ("v1.2.0", "## 1.2.0 (unreleased)", "1.2.0", "write the day"),
        ("v1.2.0", "## 1.2.0 (2026-12-31)", "1.1.0", "CITATION.cff is of another version"),
    ],
)
def test_a_tag_is_published_only_where_all_agree(tag, heading, cited, complaint, tmp_path, monkeypatch):
    (tmp_path / "ngpt").mkdir()
    (tmp_path / "ngpt" / "version.py").write_text('"""Of "it"."""\n\n__version__ = "1.2.0"\n')
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n{heading}\n")
    (tmp_path / "CITATION.cff").write_text(f"version: {cited}\n")
    monkeypatch.setattr(rules, "ROOT", tmp_path)
    told = rules.problems(tag)
    assert told == [] if complaint is None else len(told) == 1 and complaint in told[0]


def test_the_recipe_needs_what_the_package_needs():
    assert f'version: "{rules.version()}"' in RECIPE
    needs = re.search(r"  run:\n((?:    - .+\n)+)", RECIPE)[1]
    named = dict(re.findall(r"    - (\S+) (>=\S+)", needs))
    wanted = dict(re.match(r"([\w-]+)(>=[\d.]+)", line).groups() for line in PROJECT["dependencies"])
    wanted = {name.lower(): least for name, least in wanted.items() if name.lower() not in LACKING}
    expected = {CONDA.get(name, name): least for name, least in wanted.items()}
    assert named == expected | {"python": PROJECT["requires-python"]}


def test_every_extra_for_users_is_tried():
    assert release.TRIALS.keys() == {"", *PROJECT["optional-dependencies"]} - {"dev", "docs", "fuzz"}


def test_workflows_call_what_is_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for workflow in (ROOT / ".github" / "workflows").glob("*.yml"):
        text = workflow.read_text()
        for line in re.findall(r"make ((?:[a-z-]+ ?)+)", text):
            assert set(line.split()) <= targets, line
        for path in re.findall(r"(?:tests|scripts)/[\w/.-]+|\./\.github/\S+", text):
            assert (ROOT / path).exists(), path
        for module in re.findall(r"python -m (scripts[\w.]+)", text):
            assert list(ROOT.glob(f"{module.replace('.', '/')}*")), module
