"""What a cached picture depends on: the code that renders it and the scene, not what is written about either."""

import re
import shutil
from pathlib import Path

import pytest

from data_gen import code, service
from ngpt.evaluation.config import EvaluationConfig
from ngpt.evaluation.keys import scene_hash
from ngpt.evaluation.stacks import SceneStacks

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A copy of data_gen that the keys are made of."""
    shutil.copytree(ROOT / "data_gen", tmp_path / "data_gen", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code, "ROOT", tmp_path / "data_gen")
    return tmp_path / "data_gen"


def key_of(scene: str, folder: Path, sampler: str = "gpt") -> str:
    return SceneStacks("s", scene, EvaluationConfig(scenes=(scene,)), folder, service).key(sampler)


def test_a_sampler_has_the_key_of_the_code_it_runs(tree, tmp_path):
    """What is shared changes all, a sampler's own code that sampler, and those that use it."""
    names = ("auto", "gpt", "primal", "ppm", "bre")
    last: dict[str, str] = {}

    def changed(file: str = "", text: str = "\nsomething = 1\n") -> set[str]:
        """Whose keys change with that text at the end of a file."""
        if file:
            (tree / file).write_text(((tree / file).read_text() if (tree / file).exists() else "") + text)
        now = {name: key_of("diffuse", tmp_path, name) for name in names}
        found = {name for name, key in now.items() if key != last.get(name)}
        last.update(now)
        return found

    assert changed() == {*names} and changed() == set()
    for shared in ("film/gradient_film.py", "samplers/registry.py"):
        assert changed(shared) == {*names}, shared
    assert changed("samplers/gpt/about.py") == {"auto", "gpt"}
    # primal walks the base paths of gpt where lamps are chosen by place.
    assert changed("samplers/gpt/offset_path.py") == {"auto", "gpt", "primal"}
    assert changed("samplers/photons/map/trace.py") == {"ppm", "bre"} and changed("samplers/photons/bre.py") == {"bre"}
    assert changed("paths/fresh.py") == set()
    late = "\ndef late():\n    from data_gen.paths import fresh\n"
    assert changed("samplers/primal/sampler.py", late) == changed("paths/fresh.py") == {"primal"}


def test_code_of_built_in_scenes_changes_their_keys_only(tree, tmp_path):
    (tmp_path / "scene.xml").write_text("<scene/>")
    scenes = ("diffuse", str(tmp_path / "scene.xml"))
    built_in, own = (key_of(scene, tmp_path) for scene in scenes)
    for file in ("scenes/builtin.py", "scenes/grids.py"):
        (tree / file).write_text((tree / file).read_text() + "\nsomething = 1\n")
        before, (built_in, now) = built_in, (key_of(scene, tmp_path) for scene in scenes)
        assert built_in != before and now == own


def test_what_renders_nothing_does_not_change_the_key(tree, tmp_path):
    before = key_of("diffuse", tmp_path)
    film = tree / "film" / "gradient_film.py"
    film.write_text("# A remark.\n" + re.sub(r'"""(?=[A-Z])', '"""More words. ', film.read_text()))
    files = ("dataset/crops.py", "scenes/procedural/scenes.py", "inspect.py", "choosing/plans.py", "__main__.py")
    for name in (*files, "session.py", "cli/render.py", "samplers/photons/about.py", "samplers/__init__.py"):
        (tree / name).write_text((tree / name).read_text() + "\nsomething = 1\n")
    assert key_of("diffuse", tmp_path) == before


def test_the_hash_of_a_scene_is_that_of_all_its_files(tmp_path):
    (tmp_path / "scene.xml").write_text('<scene><include filename="part.xml"/></scene>')
    (tmp_path / "part.xml").write_text('<string name="filename" value="meshes/m.ply"/><float value="0.5"/>')
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/m.ply").write_text("one")
    hashes = [scene_hash(str(tmp_path / "scene.xml"))]
    assert hashes[0] == scene_hash(str(tmp_path / "scene.xml"))
    (tmp_path / "meshes/m.ply").write_text("two")
    hashes.append(scene_hash(str(tmp_path / "scene.xml")))
    (tmp_path / "scene.xml").write_text("<scene/>")
    hashes.append(scene_hash(str(tmp_path / "scene.xml")))
    assert len({*hashes, code.scene_code("diffuse"), code.scene_code("glossy")}) == 5
