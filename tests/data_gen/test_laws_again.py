"""A law runs again where its code has changed, however deep; with the code with which it passed last it is skipped."""

import os
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import pytest

from ngpt.system.source import code_text

ROOT = Path(__file__).parents[2]


@pytest.fixture
def laws():
    spec = spec_from_file_location("laws", ROOT / "tests/data_gen/laws/conftest.py")
    spec.loader.exec_module(laws := module_from_spec(spec))
    return laws


def test_a_law_depends_on_all_code_that_its_sampler_imports(laws, monkeypatch):
    changed = set()
    monkeypatch.setattr(laws, "_text", lambda file: file.relative_to(ROOT).as_posix() in changed)

    def codes(*files):
        changed.update(files)
        laws.hash_of.cache_clear()
        law = {"path": ROOT / "tests/data_gen/renders.py"}
        params = ({"name": name} for name in ("gpt", "ppm"))
        return [laws.code_of(SimpleNamespace(callspec=SimpleNamespace(params=p), **law)) for p in params]

    before, again = codes(), codes()
    assert before == again
    shared = codes("data_gen/paths/walk.py")
    assert shared[0] != before[0] and shared[1] != before[1]
    of_photons = codes("data_gen/samplers/photons/map/trace.py")
    assert of_photons[0] == shared[0] and of_photons[1] != shared[1]


def test_remarks_are_no_code(tmp_path):
    file, texts = tmp_path / "a.py", []
    for text in ("x = 1\n", '"""A docstring."""\nx = 1  # A comment\n', "x = 2\n"):
        file.write_text(text)
        texts.append(code_text(file))
    assert texts[0] == texts[1] != texts[2]


def test_a_law_is_skipped_only_where_it_has_passed_with_the_same_code(laws, monkeypatch, tmp_path):
    law = SimpleNamespace(nodeid="law", fixturenames=())
    monkeypatch.setattr(laws, "PASSED", tmp_path / "passed")

    def runs(code, passes, strict="0"):
        monkeypatch.setattr(laws, "code_of", lambda item: code)
        monkeypatch.setenv("NGPT_STRICT", strict)
        try:
            laws.pytest_runtest_setup(law)
        except pytest.skip.Exception:
            return False
        hook = laws.pytest_runtest_makereport(law, SimpleNamespace(when="call"))
        next(hook)
        with pytest.raises(StopIteration):
            hook.send(SimpleNamespace(passed=passes))
        return True

    assert runs("old", passes=False) and runs("old", passes=True)
    assert not runs("old", passes=True) and runs("old", passes=True, strict="1")
    assert runs("new", passes=True) and not runs("new", passes=True)


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
