"""A law runs again where its code has changed, however deep; with the code with which it passed last it is skipped."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAWS = Path("tests") / "data_gen" / "laws"
LAW = """
import pytest
@pytest.mark.parametrize("name", ["gpt", "ppm"])
def test_law(name): {}
"""


@pytest.fixture
def tree(tmp_path):
    """A copy of what renders, with a law of two samplers."""
    for name in ("ngpt", "data_gen"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("weights"))
    (tmp_path / LAWS).mkdir(parents=True)
    for file in ("references.py", "references.npz", "laws/conftest.py"):
        shutil.copy(ROOT / "tests" / "data_gen" / file, tmp_path / "tests" / "data_gen" / file)
    (tmp_path / LAWS / "test_law.py").write_text(LAW.format("pass"))
    return tmp_path


def ran(tree, strict="0"):
    """The samplers whose law ran."""
    places = os.pathsep.join(map(str, (tree, tree / "tests" / "data_gen")))
    more = {"PYTHONPATH": places, "XDG_CACHE_HOME": str(tree / "cache"), "NGPT_STRICT": strict}
    more["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    words = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", LAWS / "test_law.py"]
    told = subprocess.run(words, cwd=tree, env=os.environ | more, capture_output=True, text=True, timeout=300).stdout
    found = dict(re.findall(r"test_law\[(\w+)\] (PASSED|FAILED|SKIPPED)", told))
    assert found.keys() == {"gpt", "ppm"}, told
    return {name for name, outcome in found.items() if outcome != "SKIPPED"}


def test_a_law_runs_where_its_code_is_not_that_with_which_it_passed(tree):
    shared, of_photons = tree / "data_gen/paths/walk.py", tree / "data_gen/samplers/photons/map/trace.py"
    assert ran(tree) == {"gpt", "ppm"}
    shared.write_text(shared.read_text() + "# A remark is no code.\n")
    assert ran(tree) == set()
    assert ran(tree, strict="1") == {"gpt", "ppm"}
    assert shared.read_text().count("_MOST = 0.95") == 1
    shared.write_text(shared.read_text().replace("_MOST = 0.95", "_MOST = 0.96"))
    assert ran(tree) == {"gpt", "ppm"}
    of_photons.write_text(of_photons.read_text() + "something = 1\n")
    assert ran(tree) == {"ppm"}


def test_a_law_that_failed_runs_again(tree):
    (tree / LAWS / "test_law.py").write_text(LAW.format("assert name == 'ppm'"))
    assert ran(tree) == {"gpt", "ppm"} and ran(tree) == {"gpt"}


LOADED = """
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

sys.path[:0] = ["tests", "tests/data_gen", "tests/data_gen/laws"]
from data_gen.backend import use_variant
use_variant()
import mitsuba
from data_gen.render import render_stack
from unbiased import load
render_stack(load(mitsuba, "diffuse", (4, 4)), 1, 0, "gpt", unbiased=True)
loaded = {Path(module.__file__) for module in [*sys.modules.values()] if getattr(module, "__file__", None)}
spec = spec_from_file_location("laws", "tests/data_gen/laws/conftest.py")
laws = module_from_spec(spec)
spec.loader.exec_module(laws)
known = laws.files_of(laws.ROOT / "tests/data_gen/laws/test_unbiased.py", frozenset({"gpt"}))
# Methods are loaded as well, and reconstruct nothing.
(methods,) = laws.NOT_FOLLOWED
laws.NOT_FOLLOWED = set()
known |= laws.files_of(methods, frozenset())
ours = {file for file in loaded if {laws.ROOT / name for name in ("ngpt", "data_gen", "tests")} & {*file.parents}}
print(len(ours) > 50, sorted(map(str, ours - known)))
"""


def test_all_that_a_render_loads_is_in_the_hash(renderer):
    words, environment = [sys.executable, "-c", LOADED], os.environ | {"PYTHONPATH": str(ROOT)}
    found = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert found.stdout == "True []\n", found.stdout + found.stderr
